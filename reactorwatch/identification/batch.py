"""ARX models from a record, by least squares.

The regressors X, scaled, are factored, X = Q R, and R p = Q' y solved: the normal equations X'X p = X'y would square
the condition number (Golub and Van Loan, Matrix Computations, 4th ed., section 5.3). With N rows,
n parameters and residuals r, the noise variance is r'r / (N - n) and the parameters' covariance that times (R'R)^-1
(Ljung, System Identification, 2nd ed., appendix II).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.linear_model import LinearModel
from reactorwatch.identification.linear_predictor import Kind
from reactorwatch.identification.rls import RecursiveLeastSquares
from reactorwatch.identification.scaled_record import ScaledRecord
from reactorwatch.identification.structure import ALL_ROWS, RowChoice, Scaling, Structure, as_columns

SINGULAR_CONDITION = 1e13
"""Condition number beyond which the parameters are rounding error."""


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


def fit_arx(
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
    choice: RowChoice = ALL_ROWS,
) -> LinearModel:
    """Fit an ARX model by least squares.

    Rows with a missing value, or just after a gap in time, are excluded.

    Args:
        structure: terms of the model.
        inputs: shape (rows,) or (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows,) or (rows, 1), NaN where nothing was measured.
        time: shape (rows,), increasing, in any unit; None: gaps are not detected.
        choice: rows that are fitted.

    Raises:
        InputError: too few rows, an output that is constant, or rows that don't determine the parameters.
    """
    record = ScaledRecord.of(structure, inputs, outputs, time)
    rows = record.enough_rows(choice)
    return unscale("arx", structure, record.scaling, least_squares(rows.regressors, rows.outputs))


def unscale(kind: Kind, structure: Structure, scaling: Scaling, solution: LeastSquares) -> LinearModel:
    """Make a model in the signals' own units from a solution for scaled signals.

    Args:
        kind: kind of the model.
        structure: terms of the plant.
        scaling: scaling of the signals.
        solution: solution for all parameters.
    """
    plant, size, variance = structure.parameters, solution.parameters.size, solution.noise_variance
    matrix, shift = np.eye(size), np.zeros(size)
    matrix[:plant, :plant], shift[:plant] = scaling.unscaling(structure)
    known = np.isfinite(variance) and np.all(np.isfinite(solution.inverse))
    covariance = variance * matrix @ solution.inverse @ matrix.T if known else np.full((size, size), np.inf)
    noise_sd = float(np.sqrt(variance)) * scaling.output_spreads[0]
    parameters = matrix @ solution.parameters + shift
    return LinearModel(kind, structure, parameters, covariance, noise_sd, solution.condition, solution.rows)


def solution_of(estimator: RecursiveLeastSquares) -> LeastSquares:
    """Solution from a recursive estimator."""
    return LeastSquares(
        estimator.parameters,
        estimator.unit_covariance,
        estimator.noise_variance,
        estimator.condition,
        estimator.rows,
    )
