"""Least squares: linear by QR, and of a function that is not linear in its parameters by Marquardt's method.

The regressors X, scaled, are factored, X = Q R, and R p = Q' y solved: the normal equations X'X p = X'y would square
the condition number (Golub and Van Loan, Matrix Computations, 4th ed., section 5.3). With N rows, n parameters and
residuals r, the noise variance is r'r / (N - n) and the parameters' covariance that times (R'R)^-1 (Ljung, System
Identification, 2nd ed., appendix II).

Marquardt's method (J. SIAM 11 (1963) 431) takes the gradient of the prediction for the regressors. A step to parameters
that the function does not admit, such as a model with a pole on or outside the unit circle, is shortened.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.structure import as_columns

SINGULAR_CONDITION = 1e13  # beyond it the parameters are rounding error
ITERATIONS = 200  # of a descent; it ends before where a step gains less than 1e-12 of the sum of squares


@dataclass(frozen=True)
class LeastSquares:
    """A least squares solution.

    Attributes:
        parameters: shape (parameters,).
        inverse: shape (parameters, parameters), (X'X)^-1.
        noise_variance: r'r / (rows - parameters); inf for as many rows as parameters.
        condition: condition number of the regressors.
        rows: number of rows.
    """

    parameters: NDArray[np.float64]
    inverse: NDArray[np.float64]
    noise_variance: float
    condition: float
    rows: int


def least_squares(regressors: ArrayLike, outputs: ArrayLike) -> LeastSquares:
    """Solve a least squares problem.

    Args:
        regressors: shape (rows, parameters).
        outputs: shape (rows,) or (rows, 1).

    Raises:
        InputError: fewer rows than parameters, values that are not finite, or regressors that don't determine the
            parameters.
    """
    x, y = as_columns(regressors, "regressors"), as_columns(outputs, "outputs", 1)
    rows, parameters = x.shape
    if len(y) != rows:
        raise InputError(f"regressors and outputs must have equally many rows, got {rows} and {len(y)}")
    if rows < parameters:
        raise UnfitRecordError(f"{parameters} parameters need at least {parameters} complete rows, got {rows}")
    for name, values in (("regressors", x), ("outputs", y)):
        if not np.all(np.isfinite(values)):
            row = int(np.argmin(np.isfinite(values).all(axis=1)))
            raise InputError(f"{name} must be finite, got {values[row]} in row {row + 1}")
    q, r = np.linalg.qr(x)
    values = np.linalg.svd(r, compute_uv=False)
    condition = float(values[0] / values[-1]) if values[-1] > 0.0 else np.inf
    if condition > SINGULAR_CONDITION:
        raise UnfitRecordError(
            f"the rows don't determine {parameters} parameters: condition number {condition:.1e}, at most "
            f"{SINGULAR_CONDITION:.0e} can be solved; try a lower order, slower sampling, other rows, a livelier input"
        )
    inverse_factor = np.linalg.inv(r)
    theta = np.linalg.solve(r, q.T @ y)
    residuals = y - x @ theta
    free = rows - parameters
    squares = np.sum(residuals * residuals, axis=0)
    variance = float(squares[0]) / free if free > 0 else np.inf
    return LeastSquares(theta[:, 0], inverse_factor @ inverse_factor.T, variance, condition, rows)


class Objective(Protocol):
    """Errors of one record as a function of the parameters."""

    def __call__(self, theta: Array) -> tuple[Array, Array]:
        """Errors, shape (compared rows,), and the gradient of the prediction, shape (compared rows, parameters)."""

    def admits(self, theta: Array) -> bool:
        """True if a model with these parameters is usable."""


def descend(objective: Objective, start: Array, iterations: int = ITERATIONS) -> tuple[Array, float]:
    """Minimise from a start that the objective admits; returns the parameters and their sum of squares."""
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
        if not 1e-12 * squares < gain < math.inf:
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
