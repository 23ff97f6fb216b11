"""Hypotheses that another one's noise levels mask.

All hypotheses are compared with the noise levels of the best. If that is a wrong one, its process noise is so large
that the filter follows the measurements, and the right hypothesis gains little. So if the best leaves innovations that
are not white, others are fitted again, each with noise levels of its own.
"""

import numpy as np
from msgspec.structs import replace

from reactorwatch.diagnosis.fitting import grid_search
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, Step
from reactorwatch.diagnosis.search.search import CONVERGED_NOISE, FAR_OUT, FittedHypothesis, Search, SearchResult
from reactorwatch.diagnosis.whiteness import DOUBTFUL, minus_log10_p
from reactorwatch.process.effect import Effect

OTHERS, ROUNDS = 2, 2

QUIET_SHARE = 0.003
"""Fraction of a state's scale per square root of a minute: process noise that does not mask valve stiction."""


def search_single_cause(search: Search) -> SearchResult:
    """Search for the best single effect and its alternatives, with the noise levels of the best."""
    better = search.search_single_causes()
    hidden = _find_masked_fault(search, better)
    return better if hidden is None else search.search_from(hidden, better)


def _find_masked_fault(search: Search, result: SearchResult) -> FittedHypothesis | None:
    """Find a better hypothesis and adopt its noise levels; None if there is none or the innovations are white.

    Discontinuous effects are tried even if they predict no gain: process noise masks stiction, and at a wrong magnitude
    it explains nothing.
    """
    best = result.best
    if not np.any(minus_log10_p(best.fit.w, search.run.inputs) > DOUBTFUL):
        return None
    others = {item.hypothesis.causes: item for item in reversed(result.hypotheses)}
    if not _is_discontinuous(best):
        others.pop(best.hypothesis.causes, None)
    by_bic = sorted(others.values(), key=lambda item: item.bic)
    to_fit = by_bic[:OTHERS] + [item for item in by_bic[OTHERS:] if _is_discontinuous(item)]
    candidates = {candidate.effect: candidate for candidate in result.dynamic_candidates}
    for effect in search.screen.dynamic_effects:
        if effect.is_discontinuous and (effect.name,) not in (best.hypothesis.causes, *others):
            if effect in candidates:
                to_fit.append(search.fit_candidate(candidates[effect]))
            elif not best.label:  # no effect explains anything
                to_fit.append(_fit_typical(search, effect))
    noise, better = search.noise, best
    for item in to_fit:
        search.update_noise(item)
        item = _scan_effect(search, item, best) if _is_discontinuous(item) else search.refit(item)
        if item.bic < better.bic:
            noise, better = search.noise, item
    search.noise = noise
    return None if better is best else better


def _is_discontinuous(item: FittedHypothesis) -> bool:
    return any(effect.is_discontinuous for effect in item.hypothesis.filter.effects)


def _fit_typical(search: Search, effect: Effect) -> FittedHypothesis:
    constant = Hypothesis(search.filter((effect,)), (Constant(search.run.time_min),))
    return search.evaluate(constant, (np.array([effect.typical]),))


def _scan_effect(search: Search, item: FittedHypothesis, best: FittedHypothesis) -> FittedHypothesis:
    """Fit the magnitude and onset of a discontinuous effect, with its own noise levels.

    It starts with little process noise, because noise that suits a wrong magnitude hides the error of the magnitude. An
    effect that is still far from the best is not refined.
    """
    ekf, run = item.hypothesis.filter, search.run
    quiet = (QUIET_SHARE * state.scale for state in ekf.model.states)
    process_sd = tuple(min(sd, least) for sd, least in zip(search.noise.process_sd, quiet, strict=False))
    search.noise = replace(search.noise, process_sd=process_sd)
    item = search.refit(item)
    profiles = [Hypothesis(ekf, (profile,)) for profile in (Constant(run.time_min), Step(run.time_min))]
    for closely in range(1 + ROUNDS):
        before = item.bic
        for hypothesis in profiles:
            if closely and hypothesis.profiles[0].name == item.hypothesis.profiles[0].name:
                fit = grid_search.search_fine(run, hypothesis, item.fit)
            else:
                lowest = (parameter.lower for parameter in hypothesis.profiles[0].nonlinear_parameters)
                values = [item.fit.parameters[0][0], *lowest]
                fit = grid_search.search_coarse(run, hypothesis, hypothesis.evaluate(run, (np.array(values),)))
            item = min(item, search.score_fit(hypothesis, fit), key=lambda each: each.bic)
        search.update_noise(item)
        item = search.refit(item)
        if item.bic > (before - CONVERGED_NOISE if closely else best.bic + FAR_OUT):
            break
    return item
