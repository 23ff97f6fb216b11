"""A measured run as input of a diagnosis."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.kalman.batch import InputUncertainty


@dataclass(frozen=True, eq=False)
class Run:
    """Measurements of a run, row by row.

    Attributes:
        time_min: shape (rows,), increasing.
        inputs: shape (rows, n_u); each row is held until the next one.
        measured: shape (rows, n_y); NaN where missing.
        breaks: rows after a long gap with unknown inputs; the filter restarts there.
        missing: number of missing rows before a row with changed inputs, whose time of change is uncertain, else 0,
            shape (rows,); None without any.
        starts: rows at which the plant started again, independent of the rows before; each is a break.
    """

    time_min: Array
    inputs: Array
    measured: Array
    breaks: tuple[int, ...] = ()
    missing: NDArray[np.intp] | None = None
    starts: tuple[int, ...] = ()

    @property
    def certain_inputs(self) -> Array:
        """The inputs, NaN where they are unknown until the next row; the filter restarts after it."""
        known = self.inputs.copy()
        known[np.array(self.breaks, dtype=int) - 1] = np.nan
        return known

    @property
    def uncertain_rows(self) -> NDArray[np.intp]:
        """Rows after an interval in which the inputs changed at an unknown time."""
        breaks = np.array(self.breaks, dtype=np.intp)
        return breaks if self.missing is None else np.concatenate([breaks, np.flatnonzero(self.missing)])

    @property
    def input_changes(self) -> NDArray[np.intp]:
        """Rows in which an input differs from the row before."""
        return np.flatnonzero(np.any(np.diff(self.inputs, axis=0) != 0.0, axis=1)) + 1

    @property
    def values(self) -> int:
        """Number of measured values."""
        return int(np.count_nonzero(np.isfinite(self.measured)))

    @cached_property
    def period_min(self) -> float:
        """Median sampling period."""
        return float(np.median(np.diff(self.time_min)))

    @property
    def span_min(self) -> float:
        """Duration from the first row to the last."""
        return float(self.time_min[-1] - self.time_min[0])


def input_uncertainty_of(run: Run, inputs: Array, leads_to: NDArray[np.intp] | None = None) -> InputUncertainty | None:
    """Intervals of a run in which the inputs changed at unknown times.

    Args:
        run: the record.
        inputs: inputs of a filter: the run's, then others with a known course; shape (rows, n).
        leads_to: for a filter with more rows, the run's row at or after each, shape (rows,); else None.
    """
    if run.missing is None:
        return None
    to = slice(None) if leads_to is None else leads_to
    others = np.vstack([inputs[:1], inputs[:-1]])
    others[:, : run.inputs.shape[1]] = run.inputs[to]
    return InputUncertainty.for_missing_rows(run.time_min, run.inputs, run.missing).select(to)._replace(inputs=others)
