"""Least squares whose coefficients keep to their ranges, from the sums of squares and products."""

import numpy as np

from reactorwatch.arrays import Array

_TURNS, _RIDGE = 4, 1e-9


def within(gram: Array, by: Array, lowest: Array, highest: Array) -> tuple[float, Array]:
    """Twice the gain in log likelihood, and the coefficients; those that leave their range are put to its end."""
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    free, theta = np.ones(by.size, dtype=bool), np.zeros(by.size)
    for _ in range(_TURNS):
        if not free.any():
            break
        inner = gram[np.ix_(free, free)] / np.outer(scale[free], scale[free])
        inner[np.diag_indices_from(inner)] += _RIDGE
        rest = by[free] - gram[np.ix_(free, ~free)] @ theta[~free]
        theta[free] = np.linalg.solve(inner, rest / scale[free]) / scale[free]
        inside = np.clip(theta, lowest, highest)
        beyond = free & (inside != theta)
        theta = inside
        if not beyond.any():
            break
        free &= ~beyond
    return float(theta @ (2.0 * by - gram @ theta)), theta
