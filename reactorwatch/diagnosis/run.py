"""A measured run, as the diagnosis takes it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.kalman.input_uncertainty import InputUncertainty


@dataclass(frozen=True, eq=False)
class Run:
    """What was measured, row by row.

    Attributes:
        time_min: shape (rows,), increasing.
        inputs: shape (rows, n_u); each row is held until the next one.
        measured: shape (rows, n_y); NaN where missing.
        breaks: rows before which nobody knows what the inputs did for long: a filter begins anew there.
        missing: how many rows are missing before a row with which they are others, so that nobody knows when they
            changed, but may guess it, shape (rows,), else 0; None: nowhere.
        starts: rows at which the plant started again, so that nothing before them tells its state; each is a break.
    """

    time_min: Array
    inputs: Array
    measured: Array
    breaks: tuple[int, ...] = ()
    missing: NDArray[np.intp] | None = None
    starts: tuple[int, ...] = ()

    @property
    def known_inputs(self) -> Array:
        """The inputs, and NaN where nobody knows what they did until the next row: a filter begins anew after it."""
        known = self.inputs.copy()
        known[np.array(self.breaks, dtype=int) - 1] = np.nan
        return known

    @property
    def after_doubt(self) -> NDArray[np.intp]:
        """Rows before which nobody knows what the inputs did."""
        breaks = np.array(self.breaks, dtype=np.intp)
        return breaks if self.missing is None else np.concatenate([breaks, np.flatnonzero(self.missing)])

    @property
    def moves(self) -> NDArray[np.intp]:
        """Rows in which an input is another than in the row before."""
        return np.flatnonzero(np.any(np.diff(self.inputs, axis=0) != 0.0, axis=1)) + 1

    @property
    def values(self) -> int:
        """How many values were measured."""
        return int(np.count_nonzero(np.isfinite(self.measured)))

    @property
    def span_min(self) -> float:
        """From the first row to the last."""
        return float(self.time_min[-1] - self.time_min[0])


def doubt_of(run: Run, inputs: Array, leads_to: NDArray[np.intp] | None = None) -> InputUncertainty | None:
    """The ways of a run on which nobody knows when inputs changed.

    Args:
        run: the record.
        inputs: of a filter of it: those of the run, and then others, whose courses are known; shape (rows, n).
        leads_to: if the filter has more rows, the row of the run that each is, or leads to, shape (rows,); else None.
    """
    if run.missing is None:
        return None
    to = slice(None) if leads_to is None else leads_to
    others = np.vstack([inputs[:1], inputs[:-1]])
    others[:, : run.inputs.shape[1]] = run.inputs[to]
    return InputUncertainty.for_missing_rows(run.time_min, run.inputs, run.missing).select(to)._replace(inputs=others)
