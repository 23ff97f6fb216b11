"""What a filter gives: what it expected of a row or a record, and what that was off by (see `filter`)."""

from math import log, pi
from typing import NamedTuple

import numpy as np

from reactorwatch.arrays import Array


class Innovation(NamedTuple):
    """What a row's measurements were off by, one number an output. In the row that a filter begins with all are NaN.

    Attributes:
        prediction: before the row was seen.
        residual: measured less predicted; NaN where nothing was measured.
        sd: standard deviation of the residual if the model is right.
        whitened: independent of each other and standard normal if the model is right; NaN where nothing was measured.
    """

    prediction: tuple[float, ...]
    residual: tuple[float, ...]
    sd: tuple[float, ...]
    whitened: tuple[float, ...]


class Innovations(NamedTuple):
    """What a record was off by. In rows that the filter begins with all are NaN.

    Attributes:
        prediction: shape (rows, n_y), like the next three; as for `Innovation`.
        residual: likewise.
        sd: likewise.
        whitened: likewise.
        conditional_sd: likewise; the standard deviation of the residual if those of the outputs before it are known.
        x: the state after each row, shape (rows, n_x).
        P: its covariance, shape (rows, n_x, n_x).
    """

    prediction: Array
    residual: Array
    sd: Array
    whitened: Array
    conditional_sd: Array
    x: Array
    P: Array

    @property
    def log_likelihood(self) -> Array:
        """Of what was measured in each row under the model, shape (rows,)."""
        known = np.isfinite(self.whitened)
        parts = np.where(known, 0.5 * self.whitened**2 + 0.5 * log(2 * pi) + np.log(self.conditional_sd), 0.0)
        return np.asarray(-np.sum(parts, axis=1))
