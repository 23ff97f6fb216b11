"""Search for causes in the noise: noise that grows, and hypotheses that noise levels mask.

Noise that grows: noise levels are estimated under every hypothesis, so only noise that sets in
later is a cause. Under a hypothesis without it, the normalised innovations of that output have a larger mean square
after the onset. Cumulative sums of their squares give the likelihood of every onset at once, and the best one is
evaluated in the filter, whose gain changes with the noise.

Hypotheses that another one's noise levels mask. All hypotheses are compared with the noise levels of the best. If that
is a wrong one, its process noise is so large that the filter follows the measurements, and the right hypothesis gains
little. So if the best leaves innovations that are not white, others are fitted again, each with noise levels of its
own.
"""

from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Constant, Step
from reactorwatch.diagnosis.fitting.scan import search_coarse, search_fine
from reactorwatch.diagnosis.search.search import (
    CONVERGED_NOISE,
    FAR_OUT,
    IN_QUESTION,
    FittedHypothesis,
    Search,
    SearchResult,
)
from reactorwatch.diagnosis.whiteness import DOUBTFUL, minus_log10_p
from reactorwatch.process.effect import Effect, SensorEffect

LEAST_GAIN = 30.0
"""Threshold in BIC over the same hypothesis without the noise."""

EDGE_ROWS = 50
"""Rows at both ends of the record without an onset: fewer do not determine a variance."""

CUT = 6.0
"""Standard deviations at which values are clipped, so that a few outliers are no growth."""

ALTERNATIVES = 8
"""Largest number of alternatives that are fitted again with the noise."""

_SIZES, _ROUNDS = np.geomspace(0.8, 1.25, 7), 2


def search_noise_growth(search: Search, result: SearchResult) -> SearchResult:
    """Add the noise of a sensor to the best hypothesis, if that explains the run better.

    Args:
        search: search of the run.
        result: result for causes that change the outputs themselves.
    """
    best, noise = result.best, search.noise
    grown = [item for item in (_growth(search, best, effect) for effect in search.noise_effects) if item is not None]
    if not grown:
        return result
    _, effect, part = max(grown, key=lambda item: item[0])
    found = _fit(search, _with_noise(search, best, effect, part))
    if best.bic - found.bic < LEAST_GAIN:
        search.noise = noise
        return result
    part = found.fit.parameters[found.hypothesis.causes.index(effect.name)]
    others = [item for item in result.hypotheses if item.label != best.label and item.bic < best.bic + IN_QUESTION]
    fitted = [search.refit(_with_noise(search, item, effect, part)) for item in others[:ALTERNATIVES]]
    ordered = sorted([found, *fitted], key=lambda item: item.bic)
    return SearchResult(search.noise, result.nominal_noise, result.nominal, ordered)


def _growth(search: Search, best: FittedHypothesis, effect: Effect) -> tuple[float, Effect, Array] | None:
    """Predicted gain in BIC, effect, and its size and onset; None if the noise of its sensor has not grown."""
    assert isinstance(effect, SensorEffect)
    names = best.hypothesis.filter.model.output_names
    w = best.fit.w[:, names.index(effect.output)]
    rows = np.flatnonzero(np.isfinite(w))
    squares = np.clip(w[rows], -CUT, CUT) ** 2
    if squares.size < 3 * EDGE_ROWS:
        return None
    counts, sums = np.arange(1, squares.size), np.cumsum(squares)
    before = sums[:-1] / counts
    after = (sums[-1] - sums[:-1]) / (squares.size - counts)
    total = sums[-1] / squares.size
    gain = squares.size * np.log(total) - counts * np.log(before) - (squares.size - counts) * np.log(after)
    gain = np.where(after > before, gain, 0.0)[EDGE_ROWS:-EDGE_ROWS]
    index = EDGE_ROWS + int(np.argmax(gain))
    predicted = float(np.max(gain)) - 2.0 * np.log(search.run.values)
    if predicted < LEAST_GAIN:
        return None
    sd = float(search.noise.sensor_sd(names)[names.index(effect.output)])
    onset_min = 0.5 * float(np.sum(search.run.time_min[rows[index : index + 2]]))
    return predicted, effect, np.array([sd * float(np.sqrt(after[index] - before[index])), onset_min])


def _with_noise(search: Search, item: FittedHypothesis, effect: Effect, part: Array) -> FittedHypothesis:
    """A hypothesis with the noise of a sensor added."""
    hypothesis = item.hypothesis
    ekf = search.filter((*hypothesis.filter.effects, effect))
    with_noise = Hypothesis(ekf, (*hypothesis.profiles, Step(search.run.time_min)))
    return search.evaluate(with_noise, (*item.fit.parameters, part))


def _fit(search: Search, item: FittedHypothesis) -> FittedHypothesis:
    """Estimate noise levels, the other causes and the size of the noise in turn."""
    for _ in range(_ROUNDS):
        search.update_noise(item)
        item = search.refit(item)
        *others, part = item.fit.parameters
        tried: Sequence[Sequence[Array]] = [[*others, part * [share, 1.0]] for share in _SIZES]
        fits = item.hypothesis.evaluate_all(search.run, tried)
        item = min((search.score_fit(item.hypothesis, fit) for fit in (item.fit, *fits)), key=lambda each: each.bic)
    return item


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
                fit = search_fine(run, hypothesis, item.fit)
            else:
                lowest = (parameter.lower for parameter in hypothesis.profiles[0].nonlinear_parameters)
                values = [item.fit.parameters[0][0], *lowest]
                fit = search_coarse(run, hypothesis, hypothesis.evaluate(run, (np.array(values),)))
            item = min(item, search.score_fit(hypothesis, fit), key=lambda each: each.bic)
        search.update_noise(item)
        item = search.refit(item)
        if item.bic > (before - CONVERGED_NOISE if closely else best.bic + FAR_OUT):
            break
    return item
