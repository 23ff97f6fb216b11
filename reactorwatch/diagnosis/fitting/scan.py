"""Scans where the loss has no gradient: onsets, numbers of knots, discontinuous effects such as stiction.

Refine the onset of an input-timing fault; only rows where the input changes are informative. Between two input changes
all onsets are equivalent, and the loss has no slope towards the next interval. So once the other parameters are fitted,
nearby intervals are tried; the search moves to the best of them as long as that gains.

Number of knots of a piecewise-linear profile. With too few knots a curve cannot follow; each knot too many costs BIC,
so that the curve loses to a wrong alternative. All counts are compared at once, linearised about a fit: a curve with
few knots is nearly one on a fine grid, so the gram matrix of the fine grid's signatures serves all counts.

Grid search for the magnitude and the onset of a discontinuous effect, such as valve stiction. Its innovations are
discontinuous in them, so there is no gradient: magnitudes are scanned on a wide grid, then near the best. The onset
also decides the internal state of the effect from then on, so every row after an input change may be another onset, and
with a slightly wrong magnitude the wrong onset may look best. But once an input has moved far, that state no longer
depends on the onset. So the loss for an onset is roughly that of a run without the deviation before it plus that of a
run with the deviation throughout after it: one run for each magnitude ranks all onsets, and only the likely ones are
fitted.
"""

from collections.abc import Sequence
from functools import cache
from itertools import chain
from math import log

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.fault_filter import huber_clip, huber_loss, huber_row_losses
from reactorwatch.diagnosis.fitting.hypothesis import MOST_STEPS, Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import PiecewiseLinear, Step, hat_functions
from reactorwatch.diagnosis.run import Run

NEAR = np.array([-8, -4, -2, -1, 1, 2, 4, 8])
"""Intervals to try, relative to the present one."""

MOST_ROUNDS = 8
LEAST_GAIN = 0.1
"""Threshold in log likelihood."""


def refine_onset(run: Run, hypothesis: Hypothesis, best: Fit, steps: int) -> Fit:
    """Refine the onsets of steps that shift the timing; other profiles stay.

    Args:
        run: the record.
        hypothesis: hypothesis with or without such a step.
        best: fit of the hypothesis.
        steps: maximum number of least-squares steps.
    """
    for index, profile in enumerate(hypothesis.profiles):
        if isinstance(profile, Step) and hypothesis.filter.shifts_time(index):
            best = _refine_onset(run, hypothesis, best, index, steps)
    return best


def _refine_onset(run: Run, hypothesis: Hypothesis, best: Fit, index: int, steps: int) -> Fit:
    moves_min = np.concatenate([run.time_min[:1], run.time_min[run.input_changes], run.time_min[-1:]])
    middles_min = 0.5 * (moves_min[1:] + moves_min[:-1])
    for _ in range(MOST_ROUNDS):
        size, onset_min = best.parameters[index]
        here = int(np.searchsorted(moves_min, onset_min + size, side="right")) - 1
        near = here + NEAR
        trials = [np.array([size, onset]) for onset in middles_min[near[(near >= 0) & (near < middles_min.size)]]]
        fits = hypothesis.evaluate_values(run, best, index, trials, best)
        likeliest = min(fits, key=lambda item: item.loss, default=best)
        if not likeliest.loss < best.loss - LEAST_GAIN:
            break
        best = hypothesis.fit(run, likeliest.parameters, steps)
    return best


COUNTS = (*range(3, 21), *range(22, 41, 2), *range(44, 81, 4))
"""Numbers of knots that are compared; with many, one more or less is no difference."""

GRID = 161
"""Knots of the fine grid."""

_RIDGE = 1e-9


def select_knots(
    grid: PiecewiseLinear, run: Run, hypothesis: Hypothesis, fit: Fit, index: int
) -> tuple[PiecewiseLinear, Array]:
    """Select the number of knots with the least predicted BIC; return the curve and its values.

    Args:
        grid: profile with `GRID` knots for the record's rows.
        run: the record.
        hypothesis: hypothesis with a piecewise-linear profile at `index`; that effect must not delay an output.
        fit: fit of the hypothesis.
        index: index of the effect.
    """
    curve = hypothesis.profiles[index]
    assert isinstance(curve, PiecewiseLinear)
    values = np.interp(grid.knots_min, curve.knots_min, fit.parameters[index][: curve.n_linear])
    g = hypothesis.signatures(run, fit, index, grid)
    information = signatures.gram_of_columns(g)
    gradient = g.T @ huber_clip(fit.w[2:]).ravel() + information @ values
    information += _RIDGE * np.trace(information) / GRID * np.eye(GRID)
    promised: list[tuple[float, Array]] = []
    for count in COUNTS:
        on_grid = _on_grid(count)
        a = on_grid.T @ gradient
        parameters = _solve(on_grid.T @ information @ on_grid, a)
        promised.append((count * log(run.values) - float(a @ parameters), parameters))
    _, parameters = min(promised, key=lambda item: item[0])
    return PiecewiseLinear(run.time_min, parameters.size), np.append(parameters, fit.parameters[index][curve.n_shape :])


def _solve(information: Array, a: Array) -> Array:
    try:
        return np.asarray(np.linalg.solve(information, a))
    except np.linalg.LinAlgError:  # the record carries no information about the effect
        return np.asarray(np.linalg.lstsq(information, a, rcond=1e-12)[0])


@cache
def _on_grid(count: int) -> Array:
    """Hat functions of `count` knots at the fine grid's knots, shape (GRID, count)."""
    return hat_functions(np.linspace(0.0, 1.0, GRID), count)


_SIZES = ((4.0, 12), (4.0, 48), (1.06, 9), (1.015, 7))  # reach to either side as a factor, number of sizes
_FINELY = ((1.06, 25), (1.006, 25), (1.0006, 25))
_NEARER = ((1.3, 12), (1.06, 9))
_BESIDE = ((1.06, 48),)
_USUAL, _ABOUT = 24, np.geomspace(0.8, 1.25, 24)  # usual sizes of the effect; sizes relative to one
_LIKELY_ONSETS, _ALL_OVER, _NEAREST_ROWS = 48, 32, 30  # onsets at one size: best, spread out, rows near the best
_ONSETS = 6  # onsets for which sizes are scanned
_LEAST_GAIN = 5.0  # in log likelihood


def fit_hypothesis(run: Run, hypothesis: Hypothesis, start: Sequence[Array], steps: int = MOST_STEPS) -> Fit:
    """Fit a hypothesis by least squares, and scan the magnitudes of its discontinuous effects.

    Args:
        run: the record.
        hypothesis: hypothesis with or without such effects.
        start: initial parameters of each effect.
        steps: maximum number of least-squares steps.
    """
    best = hypothesis.fit(run, start, steps)
    for index, effect in enumerate(hypothesis.filter.effects):
        if effect.is_discontinuous:
            best = scan_sizes(run, hypothesis, best, index)
            if len(hypothesis.profiles) > 1:
                best = hypothesis.fit(run, best.parameters, steps)
    return best


def scan_sizes(
    run: Run, hypothesis: Hypothesis, best: Fit, index: int, scans: Sequence[tuple[float, int]] = _SIZES
) -> Fit:
    """Scan the magnitude of one effect on ever finer grids; stop if the first grid gains nothing.

    Args:
        run: the record.
        hypothesis: hypothesis with such an effect.
        best: initial fit.
        index: index of the effect.
        scans: reach to either side of the best as a factor, and number of magnitudes, of each grid.
    """
    nothing = huber_loss(hypothesis.innovations_without(run, best, index))
    for reach, count in scans:
        values, profile = best.parameters[index], hypothesis.profiles[index]
        scaled = np.arange(values.size) < profile.n_linear
        shares = np.geomspace(1.0 / reach, reach, count)
        tried = [np.where(scaled, share * values, values) for share in shares]
        best = _best_of(run, hypothesis, best, index, tried)
        if huber_loss(best.w) > nothing - _LEAST_GAIN:
            break
    return best


def search_coarse(run: Run, hypothesis: Hypothesis, best: Fit) -> Fit:
    """Search the effect's usual magnitudes and, for a step, the likely onsets.

    Args:
        run: the record; without an input change before its last row no onset is searched for.
        hypothesis: one such effect, constant or as a step.
        best: initial fit.
    """
    usual, onsets = hypothesis.filter.effects[0].start_values, _onset_grid(run)
    sizes = np.geomspace(usual[0], usual[-1], _USUAL)
    if not hypothesis.profiles[0].nonlinear_parameters or not onsets.size:
        best = _best_of(run, hypothesis, best, 0, [np.append(size, best.parameters[0][1:]) for size in sizes])
        return scan_sizes(run, hypothesis, best, 0, _NEARER)
    for tried in (sizes, best.parameters[0][0] * _ABOUT):
        lost = zip(tried, onset_losses(run, hypothesis, best, 0, tried), strict=True)
        likely = [np.array([size, onsets[np.argmin(item[run.input_changes[:-1]])]]) for size, item in lost]
        best = _best_of(run, hypothesis, best, 0, likely)
    best = _best_onset(run, hypothesis, best, _likely_onsets(run, hypothesis, best))
    return scan_sizes(run, hypothesis, best, 0, _NEARER)


def search_fine(run: Run, hypothesis: Hypothesis, best: Fit) -> Fit:
    """Refine the magnitude to 1e-4 and, for a step, the onset with it.

    With a slightly wrong magnitude another onset may look best, so magnitudes are scanned for each of the best few
    onsets.

    Args:
        run: the record.
        hypothesis: one such effect, constant or as a step.
        best: result of `search_coarse` that gains something.
    """
    profile = hypothesis.profiles[0]
    if profile.nonlinear_parameters:
        rows = profile.period_min * np.arange(-_NEAREST_ROWS, _NEAREST_ROWS + 1)
        onsets = np.concatenate([_likely_onsets(run, hypothesis, best), best.parameters[0][1] + rows])
        fits = _fit_onsets(run, hypothesis, best, np.sort(onsets))
        tried = [scan_sizes(run, hypothesis, item, 0, _BESIDE) for item in fits]
        best = min([best, *tried], key=lambda item: item.loss)
        best = _best_onset(run, hypothesis, best, best.parameters[0][1] + rows)
    return scan_sizes(run, hypothesis, best, 0, _FINELY)


def _likely_onsets(run: Run, hypothesis: Hypothesis, best: Fit) -> Array:
    """Onsets worth fitting at the present magnitude, increasing."""
    onsets = _onset_grid(run)
    (lost,) = onset_losses(run, hypothesis, best, 0, best.parameters[0][:1])
    chosen = np.zeros(onsets.size, dtype=np.bool_)
    chosen[np.argsort(lost[run.input_changes[:-1]])[:_LIKELY_ONSETS]] = True
    chosen[:: max(-(-onsets.size // _ALL_OVER), 1)] = True
    return onsets[chosen]


def _onset_grid(run: Run) -> Array:
    """Candidate onsets: midway between a row with an input change and the next row."""
    moved = run.input_changes[:-1]
    return np.asarray(0.5 * (run.time_min[moved] + run.time_min[moved + 1]))


def onset_losses(run: Run, hypothesis: Hypothesis, best: Fit, index: int, sizes: Array) -> list[Array]:
    """Approximate loss of a step of one effect after each row, up to a constant, for each magnitude."""
    never = huber_row_losses(hypothesis.innovations_without(run, best, index))
    tried = [np.array([size, run.time_min[0], *best.parameters[index][2:]]) for size in sizes]
    result = []
    for item in hypothesis.evaluate_values(run, best, index, tried, best):
        gained = never - huber_row_losses(item.w)
        result.append(np.cumsum(gained) - np.sum(gained))
    return result


def _fit_onsets(run: Run, hypothesis: Hypothesis, best: Fit, onsets: Array) -> list[Fit]:
    """Fits with the best few of these onsets, the best first; onsets that give the same path count once."""
    if not onsets.size:
        return []
    size, result = best.parameters[0][0], dict[float, Fit]()
    # Before its onset each run is the same as that with the latest onset.
    latest = hypothesis.evaluate(run, (np.array([size, np.max(onsets)]),))
    for item in hypothesis.evaluate_values(run, best, 0, [np.array([size, onset]) for onset in onsets], latest):
        result[round(item.loss, 1)] = item
        if len(result) > _ONSETS:
            del result[max(result)]
    return [result[loss] for loss in sorted(result)]


def _best_onset(run: Run, hypothesis: Hypothesis, best: Fit, onsets: Array) -> Fit:
    return min([best, *_fit_onsets(run, hypothesis, best, onsets)[:1]], key=lambda item: item.loss)


def _best_of(run: Run, hypothesis: Hypothesis, best: Fit, index: int, several: Sequence[Array]) -> Fit:
    """Best of a fit and of fits with other parameter values of one effect."""
    return min(chain([best], hypothesis.evaluate_values(run, best, index, several, best)), key=lambda item: item.loss)
