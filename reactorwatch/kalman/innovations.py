"""Predictions, innovations and filtered states of the extended Kalman filter (see `ekf`)."""

from math import log, pi
from typing import NamedTuple

import numpy as np

from reactorwatch.arrays import Array


class Innovation(NamedTuple):
    """Innovation of a row, one number an output. In the row that a filter starts with all are NaN.

    Attributes:
        prediction: predicted measurement.
        residual: the innovation, measured less predicted; NaN where nothing was measured.
        sd: standard deviation of the innovation if the model is right.
        normalized: innovation normalised by its covariance, independent and standard normal if the model is right; NaN
            where nothing was measured.
    """

    prediction: tuple[float, ...]
    residual: tuple[float, ...]
    sd: tuple[float, ...]
    normalized: tuple[float, ...]


class FilterResult(NamedTuple):
    """Innovations and filtered states of a record. In rows that the filter starts with all are NaN.

    Attributes:
        prediction: predicted measurements, shape (rows, n_y).
        residual: innovations, shape (rows, n_y); NaN where nothing was measured.
        sd: standard deviations of the innovations, shape (rows, n_y).
        normalized: normalised innovations, shape (rows, n_y); NaN where nothing was measured.
        conditional_sd: standard deviation of each innovation given those of the outputs before it, shape (rows, n_y).
        x: filtered state, shape (rows, n_x).
        P: filtered covariance, shape (rows, n_x, n_x).
    """

    prediction: Array
    residual: Array
    sd: Array
    normalized: Array
    conditional_sd: Array
    x: Array
    P: Array

    @property
    def log_likelihood(self) -> Array:
        """Log likelihood of each row's measurements, shape (rows,)."""
        measured = np.isfinite(self.normalized)
        parts = np.where(measured, 0.5 * self.normalized**2 + 0.5 * log(2 * pi) + np.log(self.conditional_sd), 0.0)
        return np.asarray(-np.sum(parts, axis=1))
