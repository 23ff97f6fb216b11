"""Search for a sensor whose noise has grown.

Noise levels are estimated under every hypothesis, so only noise that sets in later is a cause. Under a hypothesis
without it, the normalised innovations of that output have a larger mean square after the onset. Cumulative sums of
their squares give the likelihood of every onset at once, and the best one is evaluated in the filter, whose gain
changes with the noise.
"""

from collections.abc import Sequence

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.hypothesis import Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Step
from reactorwatch.diagnosis.search.search import IN_QUESTION, FittedHypothesis, Search, SearchResult
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
