"""Evidence that more than noise is left in the innovations of a fitted hypothesis."""

from math import inf, log
from typing import cast

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
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
    return log_evidence_of_sums(sums_of(w, measured))


def sums_dtype(n_y: int) -> np.dtype[np.void]:
    """Sums of innovations: `rows`, then for each of `SUMMED_ROWS` and each output, shape (3, n_y), the other fields.

    `square` has the sum of the squares of the blocks' sums, each over its number of values, and `count` the number of
    blocks with values; `sum` and `summed` have the sum of the values of the block that is not full yet, and their
    number.
    """
    shape = (len(SUMMED_ROWS), n_y)
    return np.dtype([("rows", "<i8"), *((name, "<f8", shape) for name in ("square", "count", "sum", "summed"))])


def sums_of(w: Array, measured: NDArray[np.bool_]) -> np.void:
    """Sums of rows, see `log_evidence_of_residual`."""
    sums, clipped = np.zeros(1, sums_dtype(w.shape[1]))[0], np.clip(w, -HUBER, HUBER)
    sums["rows"] = len(w)
    for index, rows in enumerate(SUMMED_ROWS):
        full = len(w) // rows * rows
        counts = np.sum(measured[:full].reshape(-1, rows, w.shape[1]), axis=1)
        totals = np.sum(clipped[:full].reshape(-1, rows, w.shape[1]), axis=1)
        sums["square"][index] = np.sum(totals**2 / np.maximum(counts, 1), axis=0)
        sums["count"][index] = np.sum(counts > 0, axis=0)
        sums["sum"][index] = np.sum(clipped[full:], axis=0)
        sums["summed"][index] = np.sum(measured[full:], axis=0)
    return cast(np.void, sums)


def log_evidence_of_sums(sums: np.void) -> float:
    """Evidence as `log_evidence_of_residual`, from the sums of one hypothesis."""
    return log_evidence_of_squares(sums["square"], sums["count"])


@jit
def log_evidence_of_squares(square: Array, count: Array) -> float:
    """Evidence as `log_evidence_of_residual`, from these two fields of `sums_dtype`."""
    best, n_y = -inf, square.shape[1]
    for b in range(len(square)):
        total = n = 0.0
        for j in range(n_y):  # the first blocks are single rows
            variance = (TRAINING_VALUES + square[0, j]) / (TRAINING_VALUES + count[0, j])
            total += square[b, j] / min(max(variance, 1.0 / LARGEST_VARIANCE), LARGEST_VARIANCE)
            n += count[b, j]
        if n > 0.0:
            larger = 0.5 * (total - n - n * log(total / n)) if total > n else 0.0
            best = max(best, larger - 0.5 * log(n))
    return (best if best > -inf else 0.0) - log(len(square))
