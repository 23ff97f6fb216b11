"""Ways from a row to the next on which an input changed, and nobody knows when.

Rows are missing, and behind them an input is another. Each of the missing rows and the one after them may be the one
that it changed with, and none is likelier than another. So the state is followed from each of these moments; it is on
average the mean of where they lead, and its covariance is their spread about it. To add to what it would be without a
change a share of what the change makes of it is not enough: the temperature goes with the time that is left from the
change on, but the concentration, which only follows the temperature, with the square of it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array


class Doubt(NamedTuple):
    """The ways of a record that are in doubt; of each row, the way that leads to it.

    Attributes:
        inputs: those that may have held already, shape (rows, n_u).
        first_min: the first moment from which they may have, shape (rows,).
        last_min: the last one, likewise; the others are at even distances between them.
        moments: how many there are, shape (rows,); 0 where there is no doubt.
    """

    inputs: Array
    first_min: Array
    last_min: Array
    moments: NDArray[np.intp]

    @classmethod
    def behind(cls, time_min: Array, inputs: Array, missing: NDArray[np.intp]) -> "Doubt":
        """Of a record in which rows are missing where inputs changed.

        Args:
            time_min: of its rows, shape (rows,).
            inputs: that hold from each row on, shape (rows, n_u).
            missing: how many rows are missing before each row with whose inputs it is not known since when they hold,
                shape (rows,); else 0.
        """
        before = np.append(time_min[:1], time_min[:-1])
        moments = np.where(missing > 0, missing + 1, 0)
        return cls(inputs, before + (time_min - before) / np.maximum(moments, 1), time_min, moments)

    def of_rows(self, rows: slice | NDArray[np.intp]) -> "Doubt":
        """Of some rows."""
        return Doubt(self.inputs[rows], self.first_min[rows], self.last_min[rows], self.moments[rows])

    @property
    def rows(self) -> NDArray[np.bool_]:
        """To which ways in doubt lead, shape (rows,)."""
        return np.asarray(self.moments > 0)

    def times_min(self, row: int) -> list[float]:
        """The moments of a way, in order."""
        found: list[float] = np.linspace(self.first_min[row], self.last_min[row], self.moments[row]).tolist()
        return found
