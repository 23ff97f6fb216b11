"""Intervals in which an input changed at an unknown time.

Rows are missing, and after them an input has another value. It may have changed with any of the missing rows or with
the row after them, each as likely. So the state is predicted for each of these times; the prior mean is the mean of the
predictions, and their spread is added to its covariance. A share of the change's effect would not do: the temperature's
response grows with the time since the change, but the concentration's, which follows the temperature, with its square.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array


class InputUncertainty(NamedTuple):
    """The uncertain intervals of a record, each in the row at its end.

    Attributes:
        inputs: inputs after the change, shape (rows, n_u).
        first_min: earliest time of the change, shape (rows,).
        last_min: latest time of the change, shape (rows,); the others are evenly spaced between them.
        n_times: number of possible times, shape (rows,); 0 where the inputs are known.
    """

    inputs: Array
    first_min: Array
    last_min: Array
    n_times: NDArray[np.intp]

    @classmethod
    def for_missing_rows(cls, time_min: Array, inputs: Array, missing: NDArray[np.intp]) -> "InputUncertainty":
        """Mark the intervals with missing rows.

        Args:
            time_min: times of the rows, shape (rows,).
            inputs: inputs that hold from each row on, shape (rows, n_u).
            missing: number of rows missing before each row whose inputs hold since an unknown time, else 0, shape
                (rows,).
        """
        before = np.append(time_min[:1], time_min[:-1])
        n_times = np.where(missing > 0, missing + 1, 0)
        return cls(inputs, before + (time_min - before) / np.maximum(n_times, 1), time_min, n_times)

    def select(self, rows: slice | NDArray[np.intp]) -> "InputUncertainty":
        """Select rows."""
        return InputUncertainty(self.inputs[rows], self.first_min[rows], self.last_min[rows], self.n_times[rows])

    @property
    def rows(self) -> NDArray[np.bool_]:
        """True for rows at the end of an uncertain interval, shape (rows,)."""
        return np.asarray(self.n_times > 0)

    def changes(self, row: int) -> list[tuple[float, list[float]]]:
        """Possible changes before a row, at increasing times, each with the inputs from then on; empty: none."""
        times: list[float] = np.linspace(self.first_min[row], self.last_min[row], self.n_times[row]).tolist()
        inputs: list[float] = self.inputs[row].tolist()
        return [(time, inputs) for time in times]
