"""Least squares from the normal equations: bounded solutions and covariances."""

import numpy as np

from reactorwatch.arrays import Array

_TURNS, _RIDGE = 4, 1e-9


def solve_bounded(gram: Array, by: Array, lowest: Array, highest: Array) -> tuple[float, Array]:
    """Solve by an active set: coefficients beyond a bound are fixed to it.

    Returns twice the gain in log likelihood, and the solution.
    """
    scale = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    free, solution = np.ones(by.size, dtype=bool), np.zeros(by.size)
    for _ in range(_TURNS):
        if not free.any():
            break
        inner = gram[np.ix_(free, free)] / np.outer(scale[free], scale[free])
        inner[np.diag_indices_from(inner)] += _RIDGE
        residual = by[free] - gram[np.ix_(free, ~free)] @ solution[~free]
        solution[free] = np.linalg.solve(inner, residual / scale[free]) / scale[free]
        inside = np.clip(solution, lowest, highest)
        beyond = free & (inside != solution)
        solution = inside
        if not beyond.any():
            break
        free &= ~beyond
    return float(solution @ (2.0 * by - gram @ solution)), solution


def inverse(information: Array) -> Array:
    """Pseudo-inverse of an information matrix, scaled so that the units of the parameters do not matter."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    inner = np.linalg.pinv(information / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    return np.asarray(inner / np.outer(scale, scale))
