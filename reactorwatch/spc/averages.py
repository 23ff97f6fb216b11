"""Exponentially weighted averages of rows, and how many independent values they are."""

import numpy as np

from reactorwatch.arrays import Array


def ewma(rows: Array, weight: float) -> Array:
    """Averages of rows from 0 on, same shape; `scipy.signal` has them, and takes half a second to import.

    Args:
        rows: shape (..., n, signals).
        weight: weight of the newest row, in (0, 1].
    """
    if weight == 1.0:
        return rows
    size = 64  # rows that are averaged at once
    lag = np.subtract.outer(np.arange(size), np.arange(size))
    weights = np.where(lag >= 0, weight * (1.0 - weight) ** np.maximum(lag, 0), 0.0)
    kept = ((1.0 - weight) ** np.arange(1, size + 1))[:, None]
    averages, last = np.empty_like(rows), np.zeros_like(rows[..., :1, :])
    for start in range(0, rows.shape[-2], size):
        block = rows[..., start : start + size, :]
        count = block.shape[-2]
        averages[..., start : start + count, :] = weights[:count, :count] @ block + kept[:count] * last
        last = averages[..., start + count - 1 : start + count, :]
    return averages


def independent_rows(averages: Array, lags: int) -> float:
    """Degrees of freedom of the mean square of each average, n / (1 + 2 sum r_k^2) with n rows (Bartlett 1946).

    Args:
        averages: averages, shape (n, signals); their correlations r_k are averaged over the signals.
        lags: number of rows from which on they are not correlated.
    """
    sums = np.maximum(np.sum(averages**2, axis=0), 1e-300)
    squares = [float(np.mean(np.sum(averages[k:] * averages[:-k], axis=0) / sums)) ** 2 for k in range(1, lags)]
    return len(averages) / (1.0 + 2.0 * sum(squares))
