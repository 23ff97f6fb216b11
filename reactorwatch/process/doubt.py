"""Ways from a row to the next on which an input changed, and nobody knows when.

Rows are missing, and behind them an input is another. Of n missing rows and the one after them each may be the one that
it changed with, and none is likelier than another. So it was for a share of the way already what it is then, and that
share has, with s = n / (2 (n + 1)), the mean s and the variance s (1 - s) / 3. What the two inputs make of the state
over the whole way differs by d; what the change makes of it is on average that share of d, and its covariance is the
variance times d d'.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.process.model import Array


class Doubt(NamedTuple):
    """The ways of a record that are in doubt; of each row, the way that leads to it.

    Attributes:
        inputs: those that may have held already, shape (rows, n_u).
        early: for what share of the way they did on average, shape (rows,); 0 where there is no doubt.
    """

    inputs: Array
    early: Array

    def of_rows(self, rows: slice) -> "Doubt":
        """Of some rows."""
        return Doubt(self.inputs[rows], self.early[rows])

    @property
    def rows(self) -> NDArray[np.bool_]:
        """To which ways in doubt lead, shape (rows,)."""
        return np.asarray(self.early > 0.0)


def early_share(missing: Array) -> Array:
    """The share of the way on average, for numbers of missing rows.

    >>> early_share(np.array([1.0, 3.0])).tolist()
    [0.25, 0.375]
    """
    return np.asarray(missing / (2.0 * (missing + 1.0)))


def variance_of(share: Array) -> Array:
    """The variance of the share, for its mean."""
    return np.asarray(share * (1.0 - share) / 3.0)
