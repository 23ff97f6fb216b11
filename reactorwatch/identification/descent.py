"""Least squares of a function that is not linear in its parameters, by Marquardt's method.

J. SIAM 11 (1963) 431. A step to parameters that the function does not admit, such as a model with a pole on or outside
the unit circle, is shortened.
"""

import math
from collections.abc import Iterable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.identification.batch import LeastSquares, least_squares

ITERATIONS = 200
_PRECISION = 1e-12  # a smaller relative gain of a step ends the descent


class Objective(Protocol):
    """Errors of one record as a function of the parameters."""

    def __call__(self, theta: Array) -> tuple[Array, Array]:
        """Errors, shape (compared rows,), and the gradient of the prediction, shape (compared rows, parameters)."""

    def admits(self, theta: Array) -> bool:
        """True if a model with these parameters is usable."""


def descend(objective: Objective, start: Array, iterations: int = ITERATIONS) -> tuple[Array, float]:
    """Minimise from a start that the objective admits.

    Returns:
        The parameters and their sum of squares.
    """
    size = start.size
    theta, damping = start, 1e-3
    errors, gradient = objective(theta)
    squares = float(errors @ errors)
    for _ in range(iterations):
        factor = _triangle(np.ascontiguousarray(np.concatenate([gradient, errors[:, None]], axis=1).T))[:size]
        scales = np.linalg.norm(factor[:, :size], axis=0)
        scales = np.where(scales > 0.0, scales, 1.0)
        gain = math.inf
        while damping < 1e12:
            stacked = np.concatenate([factor[:, :size] / scales, math.sqrt(damping) * np.eye(size)])
            step = np.linalg.lstsq(stacked, np.concatenate([factor[:, size], np.zeros(size)]))[0] / scales
            candidate = theta + step
            if objective.admits(candidate):
                new_errors, new_gradient = objective(candidate)
                new_squares = float(new_errors @ new_errors)
                if new_squares <= squares:
                    gain = squares - new_squares
                    theta, errors, gradient, squares = candidate, new_errors, new_gradient, new_squares
                    damping = max(0.1 * damping, 1e-12)
                    break
            damping *= 10.0
        if not _PRECISION * squares < gain < math.inf:
            break
    return theta, squares


def best_descent(objective: Objective, starts: Iterable[Array], iterations: int = ITERATIONS) -> Array:
    """Parameters with the smallest sum of squares of the descents from some starts."""
    return min((descend(objective, start, iterations) for start in starts), key=lambda found: found[1])[0]


def solution_at(objective: Objective, theta: Array) -> LeastSquares:
    """Solution of least squares at a minimum, where the gradient takes the place of the regressors.

    Raises:
        InputError: the rows don't determine the parameters.
    """
    errors, gradient = objective(theta)
    linear = least_squares(gradient, errors)
    free = errors.size - theta.size
    variance = float(errors @ errors) / free if free > 0 else math.inf
    return LeastSquares(theta, linear.inverse, variance, linear.condition, errors.size)


@jit
def _triangle(columns: NDArray[np.float64]) -> NDArray[np.float64]:
    """R of a QR factorisation by Householder's reflections (Golub and Van Loan, algorithm 5.2.1), small and often.

    LAPACK's would wait for threads on a machine that is busy, which here takes far longer than the work.

    Args:
        columns: shape (columns, rows), of the matrix; overwritten. At least as many rows as columns.

    Returns:
        Shape (columns, columns), upper triangular.
    """
    size, rows = columns.shape
    triangle = np.zeros((size, size))
    for i in range(size):
        norm = 0.0
        for k in range(i, rows):
            norm += columns[i, k] * columns[i, k]
        norm = np.sqrt(norm)
        triangle[i, i] = -norm if columns[i, i] > 0.0 else norm
        columns[i, i] -= triangle[i, i]
        # A column of zeros needs no reflection.
        scale = -1.0 / (triangle[i, i] * columns[i, i]) if norm > 0.0 else 0.0
        for j in range(i + 1, size):
            product = 0.0
            for k in range(i, rows):
                product += columns[i, k] * columns[j, k]
            product *= scale
            for k in range(i, rows):
                columns[j, k] -= product * columns[i, k]
            triangle[i, j] = columns[j, i]
    return triangle
