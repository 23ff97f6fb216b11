"""Output-error models from a record: the recursion with the smallest simulation error.

With measurement noise on the output, an ARX model is biased: it treats the noise as a disturbance of the plant. The
output-error model minimises its simulation error,

    yhat[k] = a1 yhat[k-1] + ... + b1 u[k-d] + ... + c,      sum (y[k] - yhat[k])^2 -> min,

which is unbiased for any noise that is independent of the input (Ljung, System Identification, 2nd ed., sections 4.2
and 8.4). The gradient is exact: differentiating the recursion, g[k] = phi[k] + a1 g[k-1] + ... + an g[k-n], phi
the regressor made of yhat (Ljung, section 10.3, with the run's start taken into account). Marquardt's method
(J. SIAM 11 (1963) 431) walks down; a step that would put a pole on or outside the unit circle is shortened.

The sum has local minima (Ljung, section 10.5: none for white inputs, but these inputs are steps). So there are
several starts: the ARX model, the instrumental variable estimate, the Steiglitz-McBride iterate (IEEE Trans. AC 10
(1965) 461), and the best model of one order less with a pole at zero, so that a higher order never fits worse.

A run starts from measured rows; what their noise does dies out as the model's own poles do. The parameters' covariance
is s2 (G'G)^-1, which supposes white residuals: where the whiteness test fails it is too small.
"""

import math
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError
from reactorwatch.identification.batch import (
    LeastSquares,
    check_not_constant,
    check_row_count,
    least_squares,
    linear_model,
)
from reactorwatch.identification.instrumental_variable import instrumental_variable, stabilize
from reactorwatch.identification.linear_model import LinearModel, RunPlan, plan_run
from reactorwatch.identification.regressor import rows_of
from reactorwatch.identification.structure import ALL_ROWS, RowChoice, Scaling, Structure, as_columns

_ITERATIONS = 200
_PRECISION = 1e-12  # a smaller relative gain of a step ends the descent
_FILTERINGS = 10


class Objective(Protocol):
    """Errors of one record as a function of the parameters."""

    def __call__(self, theta: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Errors, shape (compared rows,), and the gradient of the prediction, shape (compared rows, parameters)."""

    def admits(self, theta: NDArray[np.float64]) -> bool:
        """True if the model of these parameters is stable."""


class _Objective:
    """Simulation errors of one record and their gradient."""

    def __init__(
        self,
        structure: Structure,
        inputs: NDArray[np.float64],
        outputs: NDArray[np.float64],
        plan: RunPlan,
        compared: NDArray[np.bool_],
    ) -> None:
        self.structure = structure
        self.inputs = np.ascontiguousarray(inputs)
        self.outputs = np.ascontiguousarray(outputs[:, 0])
        self.plan = plan
        self.compared = compared

    def __call__(self, theta: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Errors, shape (compared rows,), and the gradient of the simulation, shape (compared rows, parameters)."""
        s = self.structure
        run, gradient = run_with_gradient(
            theta,
            s.output_lags,
            s.input_lags,
            s.delay,
            s.offset,
            self.inputs,
            self.outputs,
            self.plan.starts,
            self.plan.running,
        )
        return self.outputs[self.compared] - run[self.compared], gradient[self.compared]

    def admits(self, theta: NDArray[np.float64]) -> bool:
        """True if all poles are inside the unit circle."""
        return bool(is_stable(np.ascontiguousarray(theta[: self.structure.output_lags])))


def fit_oe(
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
    choice: RowChoice = ALL_ROWS,
) -> LinearModel:
    """Fit an output-error model of one output.

    Args:
        structure: terms of the model; one output.
        inputs: shape (rows,) or (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows,) or (rows, 1), NaN where nothing was measured.
        time: shape (rows,), increasing, in any unit; None: gaps are not detected.
        choice: rows that the simulation is compared with.

    Raises:
        InputError: several outputs, too few rows, an output that is constant, or rows that don't determine the
            parameters.
    """
    if structure.outputs != 1:
        raise InputError(f"an output-error model has one output, got {structure.outputs}: fit one model for each")
    u = as_columns(inputs, "inputs", structure.inputs)
    y = as_columns(outputs, "outputs", 1)
    check_not_constant(y)
    scaling = Scaling.of(u, y, centred=structure.offset)
    scaled_u, scaled_y = scaling.inputs(u), scaling.outputs(y)
    theta, objective = minimise_simulation_error(structure, scaled_u, scaled_y, time, choice)
    errors, gradient = objective(theta)
    # As for least squares: at the minimum the gradient takes the place of the regressors.
    linear = least_squares(gradient, errors)
    solution = LeastSquares(theta[None, :], linear.inverse, error_variance(errors, theta.size), linear.condition)
    return linear_model(structure, scaling, solution, errors.size, simulates=True)


def minimise_simulation_error(
    structure: Structure,
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    time: ArrayLike | None = None,
    choice: RowChoice = ALL_ROWS,
    iterations: int = _ITERATIONS,
) -> tuple[NDArray[np.float64], _Objective]:
    """Find the parameters with the smallest simulation error of scaled signals, shape (parameters,).

    Returns:
        The parameters, and the errors as a function of them.
    """
    check_row_count(rows_of(structure, u, y, time, choice), len(y))
    plan = plan_run(structure, u, y, time)
    number = np.arange(len(y))
    chosen = (number >= choice.skip) & ((number - choice.skip) % choice.every == 0)
    compared = plan.running & np.isfinite(y[:, 0]) & chosen
    if compared.sum() < structure.parameters:
        raise InputError(
            f"{structure.parameters} parameters need at least {structure.parameters} rows of a simulation, "
            f"got {int(compared.sum())} of {len(y)}"
        )
    objective = _Objective(structure, u, y, plan, compared)
    starts = _starts(structure, u, y, plan, time)
    if structure.output_lags > 1 and structure.input_lags > 1:
        lags = structure.output_lags - 1, structure.input_lags - 1
        lower = Structure(*lags, structure.delay, structure.inputs, 1, structure.offset)
        smaller, _ = minimise_simulation_error(lower, u, y, time, choice, iterations)
        starts.append(pad_order(lower, smaller))
    best = min((descend(objective, start, iterations) for start in starts), key=lambda r: r[1])
    return best[0], objective


def _starts(
    structure: Structure,
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    plan: RunPlan,
    time: ArrayLike | None,
) -> list[NDArray[np.float64]]:
    rows = rows_of(structure, u, y, time)
    arx = stabilize(structure, least_squares(rows.regressors, rows.outputs).parameters[0])
    return [
        arx,
        instrumental_variable(structure, u, y, plan, time),
        _steiglitz_mcbride(structure, u, y, time, arx),
    ]


def pad_order(structure: Structure, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """Parameters of the same model with one lag more of output and inputs, which adds a pole at zero.

    Args:
        structure: structure of the model; one output.
        parameters: shape (parameters,).
    """
    lags = structure.output_lags
    middle = lags + structure.input_lags * structure.inputs
    zeros = np.zeros(structure.inputs)
    return np.concatenate([parameters[:lags], [0.0], parameters[lags:middle], zeros, parameters[middle:]])


def _steiglitz_mcbride(
    structure: Structure,
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    time: ArrayLike | None,
    theta: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Steiglitz-McBride iteration: ARX of signals filtered by 1 / (1 - a1 q^-1 - ...) of the model before."""
    lags = structure.output_lags
    for _ in range(_FILTERINGS):
        signals = np.concatenate([u, y, np.ones_like(y)], axis=1)
        filtered = _filter(np.ascontiguousarray(theta[:lags]), signals)
        rows = rows_of(structure, filtered[:, :-2], filtered[:, -2], time)
        regressors = rows.regressors.copy()
        if structure.offset:
            regressors[:, -1] = filtered[rows.position, -1]
        try:
            solution = least_squares(regressors, rows.outputs)
        except InputError:  # the filtered signals do not determine the parameters: take the last iterate
            break
        theta = stabilize(structure, solution.parameters[0])
    return theta


def descend(
    objective: Objective, start: NDArray[np.float64], iterations: int = _ITERATIONS
) -> tuple[NDArray[np.float64], float]:
    """Minimise by Marquardt's method from a start that the objective admits.

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


def error_variance(errors: NDArray[np.float64], parameters: int) -> NDArray[np.float64]:
    """Variance of the errors, shape (1,); inf for as many rows as parameters."""
    free = errors.size - parameters
    return np.array([float(errors @ errors) / free if free > 0 else math.inf])


@jit
def is_stable(a: NDArray[np.float64]) -> bool:
    """True if all poles of yhat[k] = a1 yhat[k-1] + ... lie inside the unit circle.

    By the step-down recursion to the reflection coefficients, all of which must be below 1 (Schur and Cohn; Astrom and
    Wittenmark, Computer-Controlled Systems, 3rd ed., chapter 3).
    """
    polynomial = -a
    for order in range(a.size, 0, -1):
        reflection = polynomial[order - 1]
        if not abs(reflection) < 1.0:
            return False
        scale = 1.0 - reflection * reflection
        shorter = np.empty(order - 1)
        for i in range(order - 1):
            shorter[i] = (polynomial[i] - reflection * polynomial[order - 2 - i]) / scale
        polynomial = shorter
    return True


@jit
def run_with_gradient(
    theta: NDArray[np.float64],
    output_lags: int,
    input_lags: int,
    delay: int,
    offset: bool,
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    starts: NDArray[np.bool_],
    running: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Simulate one output, with derivatives.

    Args:
        theta: shape (parameters,).
        output_lags: see `Structure`.
        input_lags: see `Structure`.
        delay: see `Structure`.
        offset: see `Structure`.
        u: shape (rows, inputs).
        y: shape (rows,).
        starts: see `RunPlan`.
        running: see `RunPlan`.

    Returns:
        The simulation, shape (rows,), and its gradient, shape (rows, parameters); NaN and 0 where it does not run.
    """
    rows, inputs = u.shape
    size = theta.size
    run = np.full(rows, np.nan)
    own = np.zeros(rows)
    gradient = np.zeros((rows, size))
    for k in range(rows):
        if not running[k]:
            continue
        if starts[k]:
            for back in range(1, output_lags + 1):
                own[k - back] = y[k - back]
                gradient[k - back] = 0.0
        for lag in range(output_lags):
            gradient[k, lag] = own[k - 1 - lag]
        for lag in range(input_lags):
            for i in range(inputs):
                gradient[k, output_lags + lag * inputs + i] = u[k - delay - lag, i]
        if offset:
            gradient[k, size - 1] = 1.0
        total = 0.0
        for i in range(size):
            total += theta[i] * gradient[k, i]
        own[k] = total
        run[k] = total
        for lag in range(output_lags):
            for i in range(size):
                gradient[k, i] += theta[lag] * gradient[k - 1 - lag, i]
    return run, gradient


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


@jit
def _filter(a: NDArray[np.float64], signals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Filter each column by 1 / (1 - a1 q^-1 - ...), from rest after a missing value."""
    filtered = np.empty_like(signals)
    for i in range(signals.shape[1]):
        for k in range(signals.shape[0]):
            total = signals[k, i]
            for lag in range(min(a.size, k)):
                before = filtered[k - 1 - lag, i]
                if before != before:
                    break
                total += a[lag] * before
            filtered[k, i] = total
    return filtered
