"""Evidence that more than noise is left in the innovations of a fitted hypothesis."""

from math import log

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.fault_filter import HUBER

SUMMED_ROWS = (1, 5, 20)
"""Numbers of rows over which innovations are summed: slow deviations show in long sums."""

TRAINING_VALUES = 500
"""Number of values by which the noise from the training counts when it is fitted to the rows."""

LARGEST_VARIANCE = 1.2
"""Largest ratio of the fitted variance to that of the training; training finds it to a few hundredths."""


def log_evidence_of_residual(w: Array, measured: NDArray[np.bool_]) -> float:
    """Logarithm of the evidence that innovations are larger than noise by a factor, over that of noise.

    The variance of each sensor's noise is fitted to the rows, within the error of the training.

    Args:
        w: normalised innovations, shape (rows, n_y); 0 where not measured.
        measured: mask of measured values, shape (rows, n_y).
    """
    clipped, evidence = np.clip(w, -HUBER, HUBER), []
    variance = (TRAINING_VALUES + np.sum(clipped**2, axis=0)) / (TRAINING_VALUES + np.sum(measured, axis=0))
    clipped = clipped / np.sqrt(np.clip(variance, 1.0 / LARGEST_VARIANCE, LARGEST_VARIANCE))
    for rows in SUMMED_ROWS:
        full = slice(len(w) // rows * rows)
        counts = np.sum(measured[full].reshape(-1, rows, w.shape[1]), axis=1)
        sums = np.sum(clipped[full].reshape(-1, rows, w.shape[1]), axis=1)
        n = int(np.sum(counts > 0))
        square = float(np.sum(sums[counts > 0] ** 2 / counts[counts > 0]))
        if n:
            larger = 0.5 * (square - n - n * log(square / n)) if square > n else 0.0
            evidence.append(larger - 0.5 * log(n))
    return max(evidence, default=0.0) - log(len(SUMMED_ROWS))
