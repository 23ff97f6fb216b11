"""A measured run, as the diagnosis takes it."""

from dataclasses import dataclass

import numpy as np

from reactorwatch.process.model import Array


@dataclass(frozen=True, eq=False)
class Run:
    """What was measured, row by row.

    Attributes:
        time_min: shape (rows,), increasing.
        inputs: shape (rows, n_u); each row is held until the next one.
        measured: shape (rows, n_y); NaN where missing.
    """

    time_min: Array
    inputs: Array
    measured: Array

    @property
    def values(self) -> int:
        """How many values were measured."""
        return int(np.count_nonzero(np.isfinite(self.measured)))

    @property
    def span_min(self) -> float:
        """From the first row to the last."""
        return float(self.time_min[-1] - self.time_min[0])
