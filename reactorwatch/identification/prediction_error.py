"""ARMAX and Box-Jenkins models from a record: a plant and a model of its disturbance, fitted by one-step prediction.

    w[k] = f1 w[k-1] + ... + fn w[k-n] + b1 u[k-d] + ... + bn u[k-d-n+1] + offset      the plant
    v[k] = d1 v[k-1] + ... + dn v[k-n] + e[k] + c1 e[k-1] + ... + cn e[k-n]            its disturbance
    y[k] = w[k] + v[k]

with e white. A Box-Jenkins model has all of these parameters, several inputs share the poles f. An ARMAX model,

    y[k] = a1 y[k-1] + ... + b1 u[k-d] + ... + offset + e[k] + c1 e[k-1] + ...,

is the same with f = d = a (Ljung, System Identification, 2nd ed., section 4.2). The parameters minimise the sum of the
squared prediction errors e; for normal e this is maximum likelihood (section 7.4). The gradient is exact: the
recursions are differentiated, in one pass. The descent is that of `output_error`, with all poles and the zeros of the
disturbance inside the unit circle. To keep the zeros there loses nothing: the mirror image of a zero gives the same
spectrum.

The sum has local minima, so there are several starts: least squares, the output-error model, the disturbance by two
regressions as of Hannan and Rissanen (Biometrika 69 (1982) 81), and a model of one order less.

A run starts from measured rows with e = 0; what this does dies out as the zeros do. At a missing output the prediction
continues with e = 0.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError
from reactorwatch.identification.batch import check_not_constant, check_row_count, least_squares
from reactorwatch.identification.instrumental_variable import mirror_poles, stabilize
from reactorwatch.identification.linear_model import RunPlan, plan_run, simulate, standard_deviations
from reactorwatch.identification.output_error import (
    descend,
    error_variance,
    is_stable,
    minimise_simulation_error,
    pad_order,
)
from reactorwatch.identification.regressor import rows_of
from reactorwatch.identification.structure import Scaling, Structure, as_columns

Kind = Literal["armax", "bj"]

LONG_ORDERS = 3
"""Order of the regression from which the innovations are estimated first, in orders of the model."""

ITERATIONS, ROUGH_ITERATIONS = 200, 20
"""Largest number of iterations of a descent, and of one that only leads to a start."""


@dataclass(frozen=True)
class PredictionErrorModel:
    """A fitted ARMAX or Box-Jenkins model, in the signals' own units.

    Attributes:
        kind: `armax` or `bj`.
        structure: lags of the plant; the disturbance has as many.
        parameters: parameters of the plant in the order of the structure, then d of a Box-Jenkins model, then c, shape
            (parameters,).
        covariance: shape (parameters, parameters).
        noise_sd: standard deviation of e.
        rows: number of rows of the fit.
    """

    kind: Kind
    structure: Structure
    parameters: Array
    covariance: Array
    noise_sd: float
    rows: int

    @property
    def parameter_count(self) -> int:
        """Number of parameters."""
        return self.parameters.size

    @property
    def standard_deviations(self) -> Array:
        """Standard deviations of the parameters, shape (parameters,)."""
        return standard_deviations(self.covariance)

    @property
    def dynamics(self) -> Array:
        """Parameters of the plant, shape (1, parameters of the structure)."""
        return self.parameters[None, : self.structure.parameters]

    def predict(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """One-step-ahead prediction; see `LinearModel.predict`."""
        u, y = as_columns(inputs, "inputs", self.structure.inputs), as_columns(outputs, "outputs", 1)
        objective = _Objective(self.kind, self.structure, u, y, plan_run(self.structure, u, y, time))
        return objective.predict(self.parameters)[0][:, None]

    def simulate(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Simulate the plant without its disturbance; see `LinearModel.simulate`."""
        u, y = as_columns(inputs, "inputs", self.structure.inputs), as_columns(outputs, "outputs", 1)
        return simulate(self.structure, self.dynamics, u, y, plan_run(self.structure, u, y, time))

    def residuals(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Measured minus one-step prediction, shape (rows, 1)."""
        return as_columns(outputs, "outputs", 1) - self.predict(inputs, outputs, time)


def full_index(kind: Kind, structure: Structure) -> NDArray[np.int64]:
    """Indices of f, b, offset, d and c among the parameters: an ARMAX model uses `a` for both f and d."""
    lags = structure.output_lags
    if kind == "bj":
        return np.arange(structure.parameters + 2 * lags)
    order = np.arange(structure.parameters + lags)
    return np.concatenate([order[: structure.parameters], order[:lags], order[structure.parameters :]])


def unscale(
    kind: Kind,
    structure: Structure,
    scaling: Scaling,
    parameters: Array,
    inverse: Array,
    *,
    variance: float,
    rows: int,
) -> PredictionErrorModel:
    """Make a model in the signals' own units from parameters for scaled signals.

    Args:
        kind: `armax` or `bj`.
        structure: lags of the plant.
        scaling: scaling of the signals.
        parameters: shape (parameters,).
        inverse: covariance of the parameters for noise of variance 1, shape (parameters, parameters).
        variance: variance of e.
        rows: number of rows of the fit.
    """
    plant = structure.parameters
    matrix, shift = np.eye(parameters.size), np.zeros(parameters.size)
    matrix[:plant, :plant], shift[:plant] = scaling.unscaling(structure)
    known = np.isfinite(variance) and np.all(np.isfinite(inverse))
    covariance = variance * matrix @ inverse @ matrix.T if known else np.full_like(matrix, np.inf)
    noise_sd = float(np.sqrt(variance)) * scaling.output_spreads[0]
    return PredictionErrorModel(kind, structure, matrix @ parameters + shift, covariance, noise_sd, rows)


class _Objective:
    """Prediction errors of one record and their gradient.

    Args:
        kind: `armax` or `bj`.
        structure: lags of the plant.
        inputs: shape (rows, inputs).
        outputs: shape (rows, 1).
        plan: rows that the prediction covers.
    """

    def __init__(
        self,
        kind: Kind,
        structure: Structure,
        inputs: Array,
        outputs: Array,
        plan: RunPlan,
    ) -> None:
        self.structure = structure
        self._inputs = np.ascontiguousarray(inputs)
        self._outputs = np.ascontiguousarray(outputs[:, 0])
        self._plan = plan
        self.compared = plan.running & np.isfinite(self._outputs)
        self._index = full_index(kind, structure)
        self.size = int(self._index.max()) + 1

    def predict(self, theta: Array) -> tuple[Array, Array]:
        """Prediction, shape (rows,), and its gradient, shape (rows, parameters); NaN and 0 where it does not run."""
        s = self.structure
        predicted, full = predict_with_gradient(
            theta[self._index],
            s.output_lags,
            s.input_lags,
            s.delay,
            self._inputs,
            self._outputs,
            self._plan.starts,
            self._plan.running,
        )
        gradient = np.zeros((full.shape[0], self.size))
        for column, index in enumerate(self._index):
            gradient[:, index] += full[:, column]
        return predicted, gradient

    def __call__(self, theta: Array) -> tuple[Array, Array]:
        """Errors, shape (compared rows,), and the gradient of the prediction, shape (compared rows, parameters)."""
        predicted, gradient = self.predict(theta)
        return (self._outputs - predicted)[self.compared], gradient[self.compared]

    def admits(self, theta: Array) -> bool:
        """True if all poles and the zeros of the disturbance are inside the unit circle."""
        lags, full = self.structure.output_lags, theta[self._index]
        polynomials = (full[:lags], full[-2 * lags : -lags], -full[-lags:])
        return all(bool(is_stable(np.ascontiguousarray(polynomial))) for polynomial in polynomials)


def fit_armax(
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
) -> PredictionErrorModel:
    """Fit an ARMAX model of one output; without inputs it is an ARMA model.

    Args:
        structure: lags of output and inputs; one output, with an offset. The disturbance has as many lags as the
            output.
        inputs: shape (rows,) or (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows,) or (rows, 1), NaN where nothing was measured.
        time: shape (rows,), increasing, in any unit; None: gaps are not detected.

    Raises:
        InputError: too few rows, an output that is constant, or rows that don't determine the parameters.
    """
    return _fit("armax", structure, inputs, outputs, time)


def fit_box_jenkins(
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
) -> PredictionErrorModel:
    """Fit a Box-Jenkins model of one output; arguments and errors as for `fit_armax`, and at least one input."""
    if structure.inputs == 0:
        raise InputError("a Box-Jenkins model needs an input, got none; without inputs it is an ARMAX model: use armax")
    return _fit("bj", structure, inputs, outputs, time)


def _fit(
    kind: Kind,
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None,
) -> PredictionErrorModel:
    u, y = as_columns(inputs, "inputs", structure.inputs), as_columns(outputs, "outputs", 1)
    check_not_constant(y)
    scaling = Scaling.of(u, y)
    scaled_u, scaled_y = scaling.inputs(u), scaling.outputs(y)
    check_row_count(rows_of(structure, scaled_u, scaled_y, time), len(y))
    theta, objective = _minimise(kind, structure, scaled_u, scaled_y, time)
    errors, gradient = objective(theta)
    # As for least squares: at the minimum the gradient takes the place of the regressors.
    inverse, variance = least_squares(gradient, errors).inverse, error_variance(errors, theta.size)[0]
    return unscale(kind, structure, scaling, theta, inverse, variance=variance, rows=errors.size)


def _minimise(kind: Kind, structure: Structure, u: Array, y: Array, time: ArrayLike | None) -> tuple[Array, _Objective]:
    """Best parameters for scaled signals, shape (parameters,), and the errors as a function of them."""
    objective = _Objective(kind, structure, u, y, plan_run(structure, u, y, time))
    needed, usable = objective.size, int(objective.compared.sum())
    if usable < needed:
        raise InputError(f"{needed} parameters need at least {needed} rows of a prediction, got {usable} of {len(y)}")
    lags, starts = structure.output_lags, _armax_starts(structure, u, y, time)
    if structure.inputs:
        rough = ITERATIONS if kind == "bj" else ROUGH_ITERATIONS
        plant, simulation = minimise_simulation_error(structure, u, y, time, iterations=rough)
        starts.append(np.concatenate([plant, -plant[:lags]]))
    if kind == "bj":
        armax = _Objective("armax", structure, u, y, plan_run(structure, u, y, time))
        best, _ = _best(armax, starts, ROUGH_ITERATIONS)
        v = np.full(y.shape, np.nan)
        v[simulation.compared, 0] = simulation(plant)[0]
        noise, _ = _minimise("armax", Structure(lags, lags, inputs=0), np.empty((len(v), 0)), v, time)
        starts = [
            np.concatenate([plant, np.zeros(2 * lags)]),
            np.concatenate([plant, noise[:lags], noise[-lags:]]),
            np.concatenate([best[: structure.parameters], best[:lags], best[-lags:]]),
        ]
    return _best(objective, starts)[0], objective


def _best(objective: _Objective, starts: list[Array], iterations: int = ITERATIONS) -> tuple[Array, float]:
    """Parameters with the smallest sum of squares of the descents from the starts, and that sum."""
    return min((descend(objective, start, iterations) for start in starts), key=lambda found: found[1])


def _armax_starts(structure: Structure, u: Array, y: Array, time: ArrayLike | None) -> list[Array]:
    """Least squares, the regressions of Hannan and Rissanen, and the best of them with one order less."""
    lags = structure.output_lags
    rows = rows_of(structure, u, y, time)
    arx = stabilize(structure, least_squares(rows.regressors, rows.outputs).parameters[0])
    starts = [np.concatenate([arx, np.zeros(lags)])]
    past = rows_of(Structure(lags, lags), _innovations(structure, u, y, time), y, time)
    both, of_plant, of_noise = np.intersect1d(rows.position, past.position, return_indices=True)
    if both.size > structure.parameters + lags:
        wide = np.concatenate([rows.regressors[of_plant], past.regressors[of_noise][:, lags : 2 * lags]], axis=1)
        theta = np.linalg.lstsq(wide, rows.outputs[of_plant, 0])[0]
        plant = stabilize(structure, theta[: structure.parameters])
        starts.append(np.concatenate([plant, -mirror_poles(-theta[structure.parameters :])]))
    if lags > 1:
        lower = Structure.of_order(lags - 1, structure.delay, structure.inputs)
        objective = _Objective("armax", lower, u, y, plan_run(lower, u, y, time))
        smaller, _ = _best(objective, _armax_starts(lower, u, y, time), ROUGH_ITERATIONS)
        noise = smaller[lower.parameters :]
        starts.append(np.concatenate([pad_order(lower, smaller[: lower.parameters]), noise, [0.0]]))
    return starts


def _innovations(structure: Structure, u: Array, y: Array, time: ArrayLike | None) -> Array:
    """Residuals of an ARX model of a high order, shape (rows, 1); NaN where it has none."""
    order = min(LONG_ORDERS * structure.output_lags + 4, len(y) // (4 * (structure.inputs + 1)))
    long = Structure(max(order, 1), max(order, 1), structure.delay, structure.inputs)
    rows = rows_of(long, u, y, time)
    e = np.full(y.shape, np.nan)
    theta = np.linalg.lstsq(rows.regressors, rows.outputs)[0]
    e[rows.position] = rows.outputs - rows.regressors @ theta
    return e


@jit
def predict_with_gradient(
    theta: NDArray[np.float64],
    lags: int,
    input_lags: int,
    delay: int,
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    starts: NDArray[np.bool_],
    running: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Predict one output one step ahead, with derivatives.

    Args:
        theta: f, b, offset, d and c, shape (parameters,).
        lags: number of lags of f, d and c.
        input_lags: see `Structure`.
        delay: see `Structure`.
        u: shape (rows, inputs).
        y: shape (rows,), NaN where nothing was measured.
        starts: see `RunPlan`.
        running: see `RunPlan`.

    Returns:
        The prediction, shape (rows,), and its gradient, shape (rows, parameters); NaN and 0 where it does not run.
    """
    rows, inputs = u.shape
    size = theta.size
    first_d = size - 2 * lags
    first_c = size - lags
    predicted = np.full(rows, np.nan)
    gradient = np.zeros((rows, size))
    w, v, e = np.zeros(rows), np.zeros(rows), np.zeros(rows)
    dw, dv, de = np.zeros((rows, size)), np.zeros((rows, size)), np.zeros((rows, size))
    for k in range(rows):
        if not running[k]:
            continue
        if starts[k]:
            for back in range(1, lags + 1):
                w[k - back] = y[k - back]
                v[k - back] = 0.0
                e[k - back] = 0.0
                dw[k - back] = 0.0
                dv[k - back] = 0.0
                de[k - back] = 0.0
        for lag in range(lags):
            dw[k, lag] = w[k - 1 - lag]
        for lag in range(input_lags):
            for i in range(inputs):
                dw[k, lags + lag * inputs + i] = u[k - delay - lag, i]
        dw[k, first_d - 1] = 1.0
        for i in range(first_d):
            w[k] += theta[i] * dw[k, i]
        disturbance = 0.0
        for lag in range(lags):
            disturbance += theta[first_d + lag] * v[k - 1 - lag] + theta[first_c + lag] * e[k - 1 - lag]
            gradient[k, first_d + lag] = v[k - 1 - lag]
            gradient[k, first_c + lag] = e[k - 1 - lag]
        for lag in range(lags):
            for i in range(size):
                dw[k, i] += theta[lag] * dw[k - 1 - lag, i]
                gradient[k, i] += theta[first_d + lag] * dv[k - 1 - lag, i] + theta[first_c + lag] * de[k - 1 - lag, i]
        measured = y[k] == y[k]
        v[k] = y[k] - w[k] if measured else disturbance
        e[k] = v[k] - disturbance
        for i in range(size):
            dv[k, i] = -dw[k, i] if measured else gradient[k, i]
            de[k, i] = dv[k, i] - gradient[k, i]
            gradient[k, i] += dw[k, i]
        predicted[k] = w[k] + disturbance
    return predicted, gradient
