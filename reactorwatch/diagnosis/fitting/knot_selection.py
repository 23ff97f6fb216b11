"""Number of knots of a piecewise-linear profile.

With too few knots a curve cannot follow; each knot too many costs BIC, so that the curve loses to a wrong alternative.
All counts are compared at once, linearised about a fit: a curve with few knots is nearly one on a fine grid, so the
gram matrix of the fine grid's signatures serves all counts.
"""

from functools import cache
from math import log

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.fault_filter import huber_clip
from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import PiecewiseLinear, hat_functions
from reactorwatch.diagnosis.run import Run

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
