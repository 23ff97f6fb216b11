"""The part of a window that hypotheses are compared on, laid out once for the filters of all of them.

The loss of a filter there is minus the log likelihood of its innovations, in the sense of Huber (1964, Robust
estimation of a location parameter, Annals of Mathematical Statistics 35): beyond `HUBER` standard deviations it grows
no faster than the deviation.

Up to the onset of its deviation every hypothesis is the plant without a fault. So that part is run through only once.
"""

from typing import NamedTuple

import numpy as np

from monitor_node.isolation.window import Window
from reactorwatch.arrays import Array
from reactorwatch.kalman.ekf import Filter, FilterState
from reactorwatch.kalman.filter_record import FilterRecord
from reactorwatch.kalman.innovations import FilterResult
from reactorwatch.kalman.resampling import insert_rows

HUBER = 4.0
LOST = 100.0
"""Standard deviations that a value counts as off where a filter has lost the plant."""


class Loss(NamedTuple):
    """What a filter makes of a stretch.

    Attributes:
        value: see the module.
        w: the whitened innovations, shape (rows, n_y); 0 where nothing was measured.
    """

    value: float
    w: Array


class Stretch:
    """Rows of a window.

    Args:
        window: that they are of.
        begin: where filters begin, with the state of the window's own; at least two rows before `rows`.
        rows: up to where in the window.
        nominal: the filter of the plant without a fault.

    Attributes:
        times: of the rows from `begin` on, in minutes.
        earliest_min: when something may set in at the earliest.
        end_min: time of the last row.
        nothing: the loss, over the rows after the first, if nothing is wrong.
        budget: of the filter steps over these rows, that of the nominal filter.
    """

    def __init__(self, window: Window, begin: int, rows: int, nominal: Filter) -> None:
        part = slice(begin + 1, rows)
        self.budget = nominal.budget
        self.times = window.time_min[begin:rows]
        self.earliest_min, self.end_min = max(window.earliest_min, float(self.times[0])), float(self.times[-1])
        uncertainty = None if window.uncertainty is None else window.uncertainty.select(part)
        # Rows that are far apart are filtered one by one, thirty times as slowly, so rows are put in between.
        rows_near = insert_rows(window.time_min[part], window.inputs[part], window.measured[part], uncertainty)
        self._own = rows_near.original_index
        self._record = FilterRecord.of(
            rows_near.time_min, rows_near.inputs, rows_near.measured, uncertainty=rows_near.uncertainty
        )
        self._known = np.isfinite(rows_near.measured)
        found = nominal.run_record(self._record, window.states[begin])
        losses, self._w = self._losses(found, 0)
        self._before = [0.0, *np.cumsum(losses).tolist()]
        self._found, self._states = found, {0: window.states[begin]}
        self.nothing = Loss(self._before[-1], self._w[self._own])

    def loss(self, kalman: Filter, onset_min: float) -> Loss:
        """That of a filter whose deviation sets in then.

        Args:
            kalman: of a hypothesis.
            onset_min: before, it is the plant without a fault.
        """
        row = int(self._record.time_min.searchsorted(onset_min))
        if row == len(self._known):
            return self.nothing
        losses, w = self._losses(kalman.run_record(self._record.after(row), self._state(row)), row)
        return Loss(self._before[row] + float(np.sum(losses)), np.concatenate([self._w[:row], w])[self._own])

    def _losses(self, found: FilterResult, row: int) -> tuple[Array, Array]:
        """Of each row from one on, and the whitened innovations."""
        # Where a filter had to begin anew it says nothing of what was measured, and did not expect it at all.
        w = np.where(self._known[row:], np.where(np.isfinite(found.normalized), found.normalized, LOST), 0.0)
        size = np.abs(w)
        within = np.minimum(size, HUBER)
        sd = found.conditional_sd
        divisors = np.where(np.isfinite(sd) & (sd > 0.0), sd, 1.0)
        return np.sum(within * (size - 0.5 * within) + np.log(divisors), axis=1), w

    def _state(self, row: int) -> FilterState:
        """That of the plant without a fault before a row."""
        if row not in self._states:
            x, P = self._found.x[row - 1], self._found.P[row - 1]
            time_min = float(self._record.time_min[row - 1]) if np.isfinite(x).all() else None  # it waits to begin anew
            inputs = tuple(self._record.inputs[row - 1].tolist())
            self._states[row] = FilterState(time_min, inputs, tuple(x.tolist()), tuple(P.ravel().tolist()))
        return self._states[row]
