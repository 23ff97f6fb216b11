"""How many knots a free curve needs.

A curve with too few cannot follow, and one with too many pays for each of them in the BIC, and so loses against a rival
that is wrong. All counts are compared at once, by the equations linearised about a fit: a curve with few knots is very
nearly one of a fine grid, so the sums of the fine grid's signatures serve for all.
"""

from functools import cache
from math import log

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.fault_filter import clipped
from reactorwatch.diagnosis.fitting.hypothesis import Fit, Hypothesis
from reactorwatch.diagnosis.fitting.profiles import Free, hats
from reactorwatch.diagnosis.run import Run

FEWEST_KNOTS, MOST_KNOTS = 3, 80
GRID = 161
"""Knots of the fine grid."""

_RIDGE = 1e-9


def fine(time_min: Array) -> Free:
    """The fine grid's curve over such rows."""
    return Free(time_min, GRID)


def best_resolved(grid: Free, run: Run, hypothesis: Hypothesis, fit: Fit, place: int) -> tuple[Free, Array]:
    """The curve with the number of knots that promises the least BIC, and its values there.

    Args:
        grid: `fine`, of the record's rows.
        run: the record.
        hypothesis: with a free curve at `place`, of an effect that makes no output late.
        fit: of it.
        place: of the effect.
    """
    curve = hypothesis.courses[place]
    assert isinstance(curve, Free)
    values = np.interp(grid.knots_min, curve.knots_min, fit.theta[place])
    g = hypothesis.signatures(run, fit, place, grid)
    information = g.T @ g
    sought = g.T @ clipped(fit.w[2:]).ravel() + information @ values
    information += _RIDGE * np.trace(information) / GRID * np.eye(GRID)
    promised: list[tuple[float, Array]] = []
    for count in range(FEWEST_KNOTS, MOST_KNOTS + 1):
        on_grid = _on_grid(count)
        a = on_grid.T @ sought
        theta = _solved(on_grid.T @ information @ on_grid, a)
        promised.append((count * log(run.values) - float(a @ theta), theta))
    _, theta = min(promised, key=lambda item: item[0])
    return Free(run.time_min, theta.size), theta


def _solved(information: Array, a: Array) -> Array:
    try:
        return np.asarray(np.linalg.solve(information, a))
    except np.linalg.LinAlgError:  # the record says nothing of the effect
        return np.asarray(np.linalg.lstsq(information, a, rcond=1e-12)[0])


@cache
def _on_grid(count: int) -> Array:
    """What curves with one knot at 1 and the others at 0 are in the grid's knots, shape (GRID, count)."""
    return hats(np.linspace(0.0, 1.0, GRID), count)
