"""The rows that a cause is looked for in, and what the filter makes of them if nothing is wrong.

Every hypothesis is compared on the same rows, so what counts is settled here. A value far off that neither the row
before nor the next one confirms is an outlier and counts as missing, whatever the cause. The filter follows a value far
off from the second row on, as the monitor's own does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite, nan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from reactorwatch.process.filter import LONGEST_GAP_MIN, Filter, FilterState
from reactorwatch.process.model import Array

Row: TypeAlias = tuple[float, float, Sequence[float]]
"""Time in minutes, input, outputs; NaN where missing."""

GATE = 6.0
"""A value so many standard deviations off has to be confirmed."""


@dataclass(frozen=True, eq=False)
class Window:
    """Rows without a long gap, and the filter's run over them.

    Attributes:
        time_min: shape (rows,).
        inputs: shape (rows, 1).
        measured: shape (rows, n_y); NaN where missing or an outlier.
        residual: what the filter was off by, shape (rows, n_y); NaN where missing or an outlier.
        used: whether a value corrected the filter, shape (rows, n_y).
        states: of the filter after each row.
    """

    time_min: Array
    inputs: Array
    measured: Array
    residual: Array
    used: NDArray[np.bool_]
    states: list[FilterState]

    @property
    def x(self) -> Array:
        """Of the filter after each row, shape (rows, n_x)."""
        return np.array([state.x for state in self.states])

    @property
    def covariance(self) -> Array:
        """Of the filter's state after each row, shape (rows, n_x, n_x)."""
        x = len(self.states[0].x)
        return np.array([state.P for state in self.states]).reshape(len(self.states), x, x)


def window_of(rows: Sequence[Row], kalman: Filter) -> Window | None:
    """The newest rows without a gap that a filter does not cross; None if there are fewer than two.

    Args:
        rows: oldest first; where the input is missing it is taken to be as it was.
        kalman: of the plant without a fault; begins anew.
    """
    kept = _without_gap(rows)
    if len(kept) < 2:
        return None
    measured = np.array([row[2] for row in kept], dtype=float)
    n_y = measured.shape[1]
    residual, off = np.full(measured.shape, nan), np.zeros(measured.shape, dtype=bool)
    used = np.zeros(measured.shape, dtype=bool)
    states: list[FilterState] = []
    accept = [False] * n_y
    kalman.restart()
    for place, (time_min, value, outputs) in enumerate(kept):
        found = kalman.update(time_min, (value,), outputs, gate=GATE, accept=accept)
        far = [abs(size) > GATE * sd for size, sd in zip(found.residual, found.sd, strict=True)]
        off[place] = far
        used[place] = [
            isfinite(size) and (follow or not out)
            for size, follow, out in zip(found.residual, accept, far, strict=True)
        ]
        residual[place] = found.residual
        accept = far
        states.append(kalman.state)
    alone = off & ~np.vstack([off[1:], np.zeros((1, n_y), dtype=bool)])
    alone &= ~np.vstack([np.zeros((1, n_y), dtype=bool), off[:-1]])
    return Window(
        np.array([row[0] for row in kept]),
        np.array([[row[1]] for row in kept]),
        np.where(alone, np.nan, measured),
        np.where(alone, np.nan, residual),
        used,
        states,
    )


def _without_gap(rows: Sequence[Row]) -> list[Row]:
    """The newest rows whose times increase without a long gap, every input known."""
    kept: list[Row] = []
    flow = nan
    for row in rows:
        if kept and not 0.0 < row[0] - kept[-1][0] <= LONGEST_GAP_MIN:
            kept = []
        flow = row[1] if isfinite(row[1]) else flow
        if isfinite(flow):
            kept.append((row[0], flow, row[2]))
    return kept
