"""Explanations that another one's noise hides.

All hypotheses are compared with the noise of the best. If that is a wrong one, its process seems so noisy that the
filter is carried along by what is measured, and under such a noise the right one shows little. So if the best leaves
what is not white, others are asked anew, each with the noise that it needs itself.
"""

import numpy as np
from msgspec.structs import replace

from reactorwatch.diagnosis.fitting import grid_search
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, Step
from reactorwatch.diagnosis.search.search import FAR_OUT, SETTLED_NOISE, Explained, Found, Search
from reactorwatch.diagnosis.whiteness import DOUBTFUL, minus_log10_p
from reactorwatch.process.effect import Effect

OTHERS, ROUNDS = 2, 2

QUIET_SHARE = 0.003
"""Of a state's scale per square root of a minute: noise that hides no valve that sticks."""


def explained_by_one(search: Search) -> Found:
    """What one effect explains best, and its rivals, with the noise of the best."""
    found = search.found()
    hidden = _uncovered(search, found)
    return found if hidden is None else search.about(hidden, found)


def _uncovered(search: Search, known: Found) -> Explained | None:
    """A better explanation, whose noise then is that of the search; None if there is none, or nothing calls for one.

    Those that act in jumps are asked too, though they promise little or nothing: with a noise that carries the filter
    along a valve that sticks does not show, and at the wrong size it explains nothing.
    """
    best = known.best
    if not np.any(minus_log10_p(best.fit.w, search.run.inputs) > DOUBTFUL):
        return None
    others = {item.hypothesis.causes: item for item in reversed(known.explained)}
    if not _jumps(best):
        others.pop(best.hypothesis.causes, None)
    by_bic = sorted(others.values(), key=lambda item: item.bic)
    asked = by_bic[:OTHERS] + [item for item in by_bic[OTHERS:] if _jumps(item)]
    leads = {lead.effect: lead for lead in known.remembering}
    for effect in search.screen.with_memory:
        if effect.is_discontinuous and (effect.name,) not in (best.hypothesis.causes, *others):
            if effect in leads:
                asked.append(search.fitted(leads[effect]))
            elif not best.key:  # nothing explains anything
                asked.append(_as_usual(search, effect))
    held, found = search.noise, best
    for item in asked:
        search.settle(item)
        item = _set_in(search, item, best) if _jumps(item) else search.refitted(item)
        if item.bic < found.bic:
            held, found = search.noise, item
    search.noise = held
    return None if found is best else found


def _jumps(item: Explained) -> bool:
    return any(effect.is_discontinuous for effect in item.hypothesis.sized.effects)


def _as_usual(search: Search, effect: Effect) -> Explained:
    constant = Hypothesis(search.sized((effect,)), (Constant(search.run.time_min),))
    return search.explained(constant, (np.array([effect.typical]),))


def _set_in(search: Search, item: Explained, best: Explained) -> Explained:
    """An effect that acts in jumps, set in when that explains most, with the noise that it needs itself.

    It begins with little noise: a process that is noisy enough for the wrong size hides how far off that is. Where it
    is far from the best even so, it is not looked at more closely.
    """
    sized, run = item.hypothesis.sized, search.run
    quiet = (QUIET_SHARE * state.scale for state in sized.model.states)
    process_sd = tuple(min(sd, least) for sd, least in zip(search.noise.process_sd, quiet, strict=False))
    search.noise = replace(search.noise, process_sd=process_sd)
    item = search.refitted(item)
    courses = [Hypothesis(sized, (course,)) for course in (Constant(run.time_min), Step(run.time_min))]
    for closely in range(1 + ROUNDS):
        before = item.bic
        for hypothesis in courses:
            if closely and hypothesis.courses[0].name == item.hypothesis.courses[0].name:
                fit = grid_search.finely(run, hypothesis, item.fit)
            else:
                numbers = [item.fit.theta[0][0], *(number.lower for number in hypothesis.courses[0].numbers)]
                fit = grid_search.roughly(run, hypothesis, hypothesis.at(run, (np.array(numbers),)))
            item = min(item, search.judged(hypothesis, fit), key=lambda each: each.bic)
        search.settle(item)
        item = search.refitted(item)
        if item.bic > (before - SETTLED_NOISE if closely else best.bic + FAR_OUT):
            break
    return item
