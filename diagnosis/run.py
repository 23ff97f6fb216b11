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
        breaks: rows before which nobody knows what the inputs did: a filter begins anew there.
    """

    time_min: Array
    inputs: Array
    measured: Array
    breaks: tuple[int, ...] = ()

    @property
    def known_inputs(self) -> Array:
        """The inputs, and NaN where nobody knows what they did until the next row: a filter begins anew after it."""
        known = self.inputs.copy()
        known[np.array(self.breaks, dtype=int) - 1] = np.nan
        return known

    @property
    def values(self) -> int:
        """How many values were measured."""
        return int(np.count_nonzero(np.isfinite(self.measured)))

    @property
    def span_min(self) -> float:
        """From the first row to the last."""
        return float(self.time_min[-1] - self.time_min[0])
