"""The size and the onset of an effect that acts in jumps, such as a valve that sticks.

Its innovations change with them in jumps, so there is no slope to climb: they are scanned, widely first and then about
the best. Where the deviation sets in decides as well where the memory of the effect stands from then on, so every row
after one in which an input moves may be another onset, and with a size that is somewhat off the wrong one may seem
best. But as soon as an input has moved far, the memory is the same whenever the deviation set in. So what an onset
explains is roughly what a run without the deviation explains before it, and one with it all along after it: a run for
each size tells of all onsets, and only the likely ones are tried.
"""

from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES
from reactorwatch.diagnosis.fitting.fault_filter import loss_of, row_losses
from reactorwatch.diagnosis.fitting.hypothesis import MOST_STEPS, Fit, Hypothesis
from reactorwatch.diagnosis.run import Run

_SIZES = ((4.0, 12), (4.0, 48), (1.06, 9), (1.015, 7))  # how far to either side, and how many
_FINELY = ((1.06, 25), (1.006, 25), (1.0006, 25))
_NEARER = ((1.3, 12), (1.06, 9))
_BESIDE = ((1.06, 48),)
_USUAL, _ABOUT = 24, np.geomspace(0.8, 1.25, 24)  # sizes: of those that an effect usually has, and in shares of one
_LIKELY_ONSETS, _ALL_OVER, _NEAREST_ROWS = 48, 32, 30  # tried with one size: how many, of how many, and how near
_ONSETS = 6  # that sizes are tried with
_LEAST_GAIN = 5.0  # in log likelihood


def fitted(run: Run, hypothesis: Hypothesis, start: Sequence[Array], steps: int = MOST_STEPS) -> Fit:
    """The best numbers that are found from a start, with sizes that act in jumps scanned.

    Args:
        run: the record.
        hypothesis: with or without such effects.
        start: where it begins, theta of each effect.
        steps: of least squares, at most.
    """
    best = hypothesis.fit(run, start, steps)
    for place, effect in enumerate(hypothesis.sized.effects):
        if effect.is_discontinuous:
            best = sized(run, hypothesis, best, place)
            if len(hypothesis.courses) > 1:
                best = hypothesis.fit(run, best.theta, steps)
    return best


def sized(run: Run, hypothesis: Hypothesis, best: Fit, place: int, scans: Sequence[tuple[float, int]] = _SIZES) -> Fit:
    """With the best size of many, then of nearer ones. Where none of the first few gains anything, none will.

    Args:
        run: the record.
        hypothesis: with such an effect.
        best: where it begins.
        place: of the effect.
        scans: how far to either side of the best, and how many sizes.
    """
    nothing = loss_of(hypothesis.without(run, best, place))
    for reach, count in scans:
        numbers, course = best.theta[place], hypothesis.courses[place]
        scaled = np.arange(numbers.size) < course.coefficients
        shares = np.geomspace(1.0 / reach, reach, count)
        tried = [np.where(scaled, share * numbers, numbers) for share in shares]
        best = _best_of(run, hypothesis, best, place, tried)
        if loss_of(best.w) > nothing - _LEAST_GAIN:
            break
    return best


def roughly(run: Run, hypothesis: Hypothesis, best: Fit) -> Fit:
    """With one of the sizes that the effect usually has, or one near it, and if it is a step with a likely onset.

    Args:
        run: the record; where no input moves before its last row no onset is looked for.
        hypothesis: one such effect, constant or as a step.
        best: where it begins.
    """
    usual, onsets = hypothesis.sized.effects[0].start_values, _between(run)
    sizes = np.geomspace(usual[0], usual[-1], _USUAL)
    if not hypothesis.courses[0].numbers or not onsets.size:
        best = _best_of(run, hypothesis, best, 0, [np.append(size, best.theta[0][1:]) for size in sizes])
        return sized(run, hypothesis, best, 0, _NEARER)
    for tried in (sizes, best.theta[0][0] * _ABOUT):
        lost = zip(tried, _profiles(run, hypothesis, best, tried), strict=True)
        best = _best_of(run, hypothesis, best, 0, [np.array([size, onsets[np.argmin(item)]]) for size, item in lost])
    return sized(run, hypothesis, _best_onset(run, hypothesis, best, _likely(run, hypothesis, best)), 0, _NEARER)


def finely(run: Run, hypothesis: Hypothesis, best: Fit) -> Fit:
    """With the best size, to a tenth of a permille, and if it is a step the best onset beside it.

    With a size that is a little off another onset may seem best, so sizes are tried with each of the best few.

    Args:
        run: the record.
        hypothesis: one such effect, constant or as a step.
        best: roughly, with a size that gains something.
    """
    course = hypothesis.courses[0]
    if course.numbers:
        rows = course.period_min * np.arange(-_NEAREST_ROWS, _NEAREST_ROWS + 1)
        onsets = np.concatenate([_likely(run, hypothesis, best), best.theta[0][1] + rows])
        tried = [sized(run, hypothesis, item, 0, _BESIDE) for item in _moved(run, hypothesis, best, np.sort(onsets))]
        best = min([best, *tried], key=lambda item: item.loss)
        best = _best_onset(run, hypothesis, best, best.theta[0][1] + rows)
    return sized(run, hypothesis, best, 0, _FINELY)


def _likely(run: Run, hypothesis: Hypothesis, best: Fit) -> Array:
    """Onsets to try with its size, increasing."""
    onsets = _between(run)
    (lost,) = _profiles(run, hypothesis, best, best.theta[0][:1])
    chosen = np.zeros(onsets.size, dtype=np.bool_)
    chosen[np.argsort(lost)[:_LIKELY_ONSETS]] = True
    chosen[:: max(-(-onsets.size // _ALL_OVER), 1)] = True
    return onsets[chosen]


def _between(run: Run) -> Array:
    """Between rows, each after one in which an input moved."""
    moved = run.moves[:-1]
    return np.asarray(0.5 * (run.time_min[moved] + run.time_min[moved + 1]))


def _profiles(run: Run, hypothesis: Hypothesis, best: Fit, sizes: Array) -> list[Array]:
    """Of each size what it loses, roughly and up to a constant, with each of the onsets between rows."""
    never = row_losses(hypothesis.without(run, best, 0))
    always = _tried(run, hypothesis, best, 0, [np.array([size, run.time_min[0]]) for size in sizes], best)
    found = []
    for item in always:
        gained = never - row_losses(item.w)
        found.append(np.cumsum(gained)[run.moves[:-1]] - np.sum(gained))
    return found


def _moved(run: Run, hypothesis: Hypothesis, best: Fit, onsets: Array) -> list[Fit]:
    """With the best few of these onsets, the best first; one of those that leave the same path."""
    if not onsets.size:
        return []
    size, found = best.theta[0][0], dict[float, Fit]()
    late = hypothesis.at(run, (np.array([size, np.max(onsets)]),))  # until an onset the filter runs as with a later one
    for item in _tried(run, hypothesis, best, 0, [np.array([size, onset]) for onset in onsets], late):
        found[round(item.loss, 1)] = item
        if len(found) > _ONSETS:
            del found[max(found)]
    return [found[loss] for loss in sorted(found)]


def _best_onset(run: Run, hypothesis: Hypothesis, best: Fit, onsets: Array) -> Fit:
    return min([best, *_moved(run, hypothesis, best, onsets)[:1]], key=lambda item: item.loss)


def _best_of(run: Run, hypothesis: Hypothesis, best: Fit, place: int, several: Sequence[Array]) -> Fit:
    """The best of a fit and of others with other numbers of one effect."""
    return min(chain([best], _tried(run, hypothesis, best, place, several, best)), key=lambda item: item.loss)


def _tried(
    run: Run, hypothesis: Hypothesis, best: Fit, place: int, several: Sequence[Array], like: Fit
) -> Iterator[Fit]:
    """Fits with other numbers of one effect, a few at a time; see `Hypothesis.at` for what they are like."""
    for begin in range(0, len(several), LANES):
        thetas = [
            [numbers if other == place else item for other, item in enumerate(best.theta)]
            for numbers in several[begin : begin + LANES]
        ]
        yield from hypothesis.at_all(run, thetas, like)
