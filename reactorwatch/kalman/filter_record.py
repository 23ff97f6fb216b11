"""A record in the layout of the compiled filter, prepared once for many runs."""

from collections.abc import Sequence
from math import inf

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.kalman.input_uncertainty import InputUncertainty
from reactorwatch.process.simulate import LONGEST_STEP_MIN

LONGEST_ROW_MIN = 1.001 * 2 * LONGEST_STEP_MIN  # a row is two steps; times are rounded


class FilterRecord:
    """The rows of a record, for `Filter.run`.

    Args:
        time_min: shape (rows,).
        inputs: shape (rows, n_u) or (rows,) for one input; NaN where unknown.
        measured: shape (rows, n_y); NaN where missing.
        gate: standard deviations beyond which a measurement does not correct the state.
        accept: measurements that correct the state whatever the gate, shape (rows, n_y); None: none.
        uncertainty: intervals in which inputs changed at an unknown time; None: there are none.

    Attributes:
        rows: the arguments `new` of the compiled rows, see `ekf_step`; the first row lacks what comes from the row
            before.
        near: True for rows at most two integration steps after the one before, shape (rows,); undecided for the first.
    """

    def __init__(
        self,
        time_min: Array,
        inputs: Array,
        measured: Array,
        gate: float = inf,
        accept: NDArray[np.bool_] | None = None,
        uncertainty: InputUncertainty | None = None,
    ) -> None:
        count, n_y = measured.shape
        inputs = inputs.reshape(count, -1)
        n_u = inputs.shape[1]
        self.time_min, self.inputs, self.measured = time_min, inputs, measured
        self.gate, self.uncertainty = gate, uncertainty
        self.accept = np.zeros(measured.shape, dtype=np.bool_) if accept is None else accept
        self.rows = rows = np.zeros((count, 2 * n_u + 3 + 2 * n_y))
        self.near = near = np.zeros(count, dtype=np.bool_)
        half = 0.5 * np.diff(time_min)
        near[1:] = (half > 0.0) & (2.0 * half <= LONGEST_ROW_MIN) & np.all(np.isfinite(inputs[:-1]), axis=1)
        if uncertainty is not None:
            near &= ~uncertainty.rows
        rows[1:, :n_u], rows[:, n_u : 2 * n_u], rows[:, 2 * n_u] = inputs[:-1], inputs, time_min
        rows[1:, 2 * n_u + 1], rows[1:, 2 * n_u + 2] = half, half
        rows[:, -2 * n_y : -n_y], rows[:, -n_y:] = measured, np.where(self.accept, inf, gate)

    def following(
        self, before_min: float | None, inputs: Sequence[float], breaks: Sequence[float]
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Complete `rows` (read-only) and `near` with what precedes the record.

        Args:
            before_min: time of the row before the first one; None if there is none.
            inputs: inputs of that row.
            breaks: times at which the right-hand side jumps, increasing.
        """
        near, times, n_u = self.near.copy(), self.time_min, self.inputs.shape[1]
        rows = self.rows if before_min is None and not breaks else self.rows.copy()
        first, second = 2 * n_u + 1, 2 * n_u + 2
        near[0] = False
        if before_min is not None:
            half = 0.5 * (times[0] - before_min)
            rows[0, :n_u], rows[0, first], rows[0, second] = inputs, half, half
            near[0] = 0.0 < 2.0 * half <= LONGEST_ROW_MIN and not (
                self.uncertainty is not None and self.uncertainty.rows[0]
            )
        for point in breaks:
            row = int(times.searchsorted(point))
            since = times[row - 1] if row else before_min
            if row < times.size and since is not None and since < point < times[row]:
                near[row] &= sum(since < other < times[row] for other in breaks) == 1
                rows[row, first], rows[row, second] = point - since, times[row] - point
        return rows, near
