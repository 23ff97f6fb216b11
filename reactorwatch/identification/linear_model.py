"""Linear models of one output: one-step-ahead prediction, simulation, and the gradient that a fit needs.

    w[k] = f1 w[k-1] + ... + fn w[k-n] + b1 u[k-d] + ... + bn u[k-d-n+1] + offset      the plant
    v[k] = d1 v[k-1] + ... + dn v[k-n] + e[k] + c1 e[k-1] + ... + cn e[k-n]            its disturbance
    y[k] = w[k] + v[k]

with e white. A Box-Jenkins model has all of these parameters, several inputs share the poles f. An ARMAX model is the
same with f = d = a, an ARX model has no c either, and an output-error model has neither d nor c: its prediction is its
simulation (Ljung, System Identification, 2nd ed., section 4.2). The gradient is exact: the recursions are
differentiated, in one pass, the start of the run taken into account (section 10.3).

A run starts from measured rows with e = 0; what this does dies out as the poles, or the zeros of the disturbance, do.
At a missing output the prediction continues with e = 0.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.identification.data import PlanArrays, RunPlan, plan_run, rows_of
from reactorwatch.identification.structure import Orders, Structure, as_columns

Kind = Literal["arx", "oe", "armax", "bj"]
"""Kind of a model; `oe` is output error, `bj` is Box-Jenkins."""

_DIVERGED = 1e100  # a simulation beyond this has diverged; its square is still finite


@dataclass(frozen=True)
class LinearModel:
    """A fitted linear model of one output, in the signals' own units.

    Attributes:
        kind: kind of the model.
        structure: terms of the plant.
        parameters: those of the plant in the order of `structure.parameter_names`, then d of a Box-Jenkins model, then
            c of it or of an ARMAX model; shape (parameters,).
        covariance: shape (parameters, parameters); inf where the data do not determine it.
        noise_sd: standard deviation of the residuals of the fit.
        condition: condition number of the scaled regressors (or gradients).
        rows: number of rows of the fit.
    """

    kind: Kind
    structure: Structure
    parameters: Array
    covariance: Array
    noise_sd: float
    condition: float
    rows: int

    @property
    def parameter_count(self) -> int:
        """Number of parameters."""
        return self.parameters.size

    @property
    def dynamics(self) -> Array:
        """Parameters of the plant, shape (parameters of the structure,)."""
        return self.parameters[: self.structure.parameters]

    @property
    def standard_deviations(self) -> Array:
        """Standard deviations of the parameters, shape (parameters,)."""
        return standard_deviations(self.covariance)

    @property
    def diverges(self) -> bool:
        """True if a pole multiplies an error by more than 100 along the rows of the fit."""
        modulus = self.largest_pole()[0]
        return modulus > 1.0 and self.rows * np.log(modulus) > np.log(100.0)

    @property
    def instability(self) -> str:
        """Pole that shows that the plant is unstable, beyond 3 sd; empty if it is stable for all the rows show."""
        modulus, sd = self.largest_pole()
        outside = self.diverges and modulus > 1.0 + 3.0 * sd
        return f"a pole at {modulus:.4g} +- {sd:.2g}, outside the unit circle" if outside else ""

    def largest_pole(self) -> tuple[float, float]:
        """Largest modulus of the poles of the plant, and its standard deviation; inf where it is not determined."""
        lags = self.structure.output_lags
        polynomial = np.concatenate([[1.0], -self.parameters[:lags]])
        poles = np.roots(polynomial)
        pole = poles[np.argmax(np.abs(poles))]
        modulus, slope = float(np.abs(pole)), np.polyval(np.polyder(polynomial), pole)
        if modulus == 0.0 or slope == 0.0:
            return modulus, np.inf
        gradient = np.real(np.conj(pole) * pole ** np.arange(lags - 1, -1, -1) / slope) / modulus
        return modulus, float(standard_deviations(self.covariance[:lags, :lags], gradient[None])[0])

    def predict(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Predict each row one step ahead from the measured rows before it.

        Args:
            inputs: shape (rows,) or (rows, inputs).
            outputs: shape (rows,) or (rows, 1).
            time: shape (rows,); None: gaps are not detected.

        Returns:
            Shape (rows, 1); NaN where the rows before are incomplete.
        """
        u, y = as_columns(inputs, "inputs", self.structure.inputs), as_columns(outputs, "outputs", 1)
        if self.kind in ("armax", "bj"):
            errors = PredictionErrors(self.kind, self.structure, u, y, plan_run(self.structure, u, y, time))
            return errors.predict(self.parameters)[0][:, None]
        rows = rows_of(self.structure, u, y, time)
        predicted = np.full(y.shape, np.nan)
        predicted[rows.position, 0] = rows.regressors @ self.parameters
        return predicted

    def simulate(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Simulate the plant, without its disturbance: run its recursion on its own outputs.

        It starts from the first complete consecutive rows, as many as its history has, and continues over missing
        outputs. At a missing input or a gap in time it stops and restarts. Arguments are those of `predict`.

        Returns:
            Shape (rows, 1); NaN in the rows it starts from and where it cannot run; inf after it has diverged.
        """
        u, y = as_columns(inputs, "inputs", self.structure.inputs), as_columns(outputs, "outputs", 1)
        return simulate(self.structure, self.dynamics, u, y, plan_run(self.structure, u, y, time))

    def residuals(self, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Array:
        """Measured minus predicted or simulated, as in the fit; shape (rows, 1)."""
        predict = self.simulate if self.kind == "oe" else self.predict
        return as_columns(outputs, "outputs", 1) - predict(inputs, outputs, time)


def fit_percent(measured: ArrayLike, predicted: ArrayLike) -> float:
    """100 (1 - |y - yhat| / |y - mean y|) over the rows that are measured and predicted.

    100 is perfect, 0 as good as the mean, and -inf a diverged simulation.

    Args:
        measured: shape (rows,), NaN where nothing was measured.
        predicted: shape (rows,), NaN where nothing was predicted.

    Returns:
        The fit; NaN if no row can be compared or the measured values are all equal.
    """
    y, yhat = np.asarray(measured, dtype=np.float64), np.asarray(predicted, dtype=np.float64)
    compared = np.isfinite(y) & ~np.isnan(yhat)
    y, yhat = y[compared], yhat[compared]
    if y.size == 0 or np.ptp(y) == 0.0:
        return float("nan")
    if not np.all(np.isfinite(yhat)):
        return float("-inf")
    return float(100.0 * (1.0 - np.linalg.norm(y - yhat) / np.linalg.norm(y - np.mean(y))))


def free_run_percent(model: object, measured: ArrayLike, run: ArrayLike) -> float:
    """`fit_percent` of a simulation; -inf also if its model multiplies errors along the record and it shows."""
    percent = fit_percent(measured, run)
    return -np.inf if percent < 0.0 and isinstance(model, LinearModel) and model.diverges else percent


def standard_deviations(
    covariance: NDArray[np.float64], matrix: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Standard deviations of linear combinations of parameters; never NaN.

    Args:
        covariance: covariance of the parameters, shape (n, n); inf and NaN where the data do not determine them.
        matrix: the combinations, shape (m, n); None: the parameters themselves.

    Returns: Shape (m,); inf where the data do not determine a combination. Where rounding makes a variance negative,
        the size of that rounding.

    >>> standard_deviations(np.array([[4.0, np.nan], [np.nan, np.inf]]), np.array([[0.5, 0.0], [1.0, 1.0]])).tolist()
    [1.0, inf]
    """
    deviations = np.full(len(covariance) if matrix is None else len(matrix), np.inf)
    for i in range(len(deviations)):
        row = np.eye(1, len(covariance), i)[0] if matrix is None else matrix[i]
        used = np.flatnonzero(row)  # zero times infinity is not zero
        part = covariance[np.ix_(used, used)]
        if np.all(np.isfinite(part)):
            deviations[i] = np.sqrt(abs(row[used] @ part @ row[used]))
    return deviations


class PredictionErrors:
    """Prediction errors of a kind of model on one record, as a function of its parameters; an `Objective`.

    Args:
        kind: kind of the model; an ARX model has a closed form instead.
        structure: terms of the plant; the disturbance has as many lags as the output.
        inputs: shape (rows, inputs).
        outputs: shape (rows, 1).
        plan: rows that the prediction covers.

    Attributes:
        size: number of parameters.
        compared: rows whose errors count, shape (rows,).
    """

    def __init__(self, kind: Kind, structure: Structure, inputs: Array, outputs: Array, plan: RunPlan) -> None:
        plant, lags = structure.parameters, structure.output_lags
        self._lags, self._plant, self._noise_lags = lags, plant, 0 if kind == "oe" else lags
        # indices of f, b, offset, d and c among the parameters
        self._index = np.arange(plant + 2 * self._noise_lags)
        if kind == "armax":  # a is both f and d
            order = np.arange(plant + lags)
            self._index = np.concatenate([order[:plant], order[:lags], order[plant:]])
        self.size = int(self._index.max()) + 1
        self._orders, self._plan = (*structure.orders, self._noise_lags), plan
        self._inputs, self._outputs = np.ascontiguousarray(inputs), np.ascontiguousarray(outputs[:, 0])
        self.compared = plan.running & np.isfinite(self._outputs)

    def predict(self, theta: Array) -> tuple[Array, Array]:
        """Prediction, shape (rows,), and its gradient, shape (rows, parameters); NaN and 0 where it does not run."""
        full = predict_with_gradient(theta[self._index], self._orders, self._inputs, self._outputs, self._plan.arrays)
        if self._index.size == self.size:
            return full
        gradient = np.zeros((len(full[1]), self.size))
        for column, i in enumerate(self._index):
            gradient[:, i] += full[1][:, column]
        return full[0], gradient

    def __call__(self, theta: Array) -> tuple[Array, Array] | None:
        """Errors and gradient; None unless all poles and the zeros of the disturbance are inside the unit circle."""
        full, plant = theta[self._index], self._plant
        d, c = full[plant : plant + self._noise_lags], full[plant + self._noise_lags :]
        if not all(is_stable(np.ascontiguousarray(part)) for part in (full[: self._lags], d, -c)):
            return None
        predicted, gradient = self.predict(theta)
        return (self._outputs - predicted)[self.compared], gradient[self.compared]


def simulate(
    structure: Structure,
    parameters: NDArray[np.float64],
    inputs: NDArray[np.float64],
    outputs: NDArray[np.float64],
    plan: RunPlan,
) -> NDArray[np.float64]:
    """`LinearModel.simulate` for parameters and signals of any scale, shape (rows, 1).

    Args:
        structure: structure of the model.
        parameters: shape (parameters,).
        inputs: shape (rows, inputs).
        outputs: shape (rows, 1).
        plan: plan for this record and structure.
    """
    theta, u, y = (np.ascontiguousarray(item) for item in (parameters, inputs, outputs[:, 0]))
    return _run(theta, structure.orders, structure.offset, u, y, plan.arrays)[:, None]


@jit
def _run(
    parameters: NDArray[np.float64],
    orders: Orders,
    offset: bool,
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    plan: PlanArrays,
) -> NDArray[np.float64]:
    (output_lags, input_lags, delays), (starts, running) = orders, plan
    rows, inputs = u.shape
    run, own = np.full(rows, np.nan), np.empty(rows)
    for k in range(rows):
        if not running[k]:
            continue
        if starts[k]:
            for back in range(1, output_lags + 1):
                own[k - back] = y[k - back]
        total = parameters[parameters.size - 1] if offset else 0.0
        for lag in range(output_lags):
            total += parameters[lag] * own[k - 1 - lag]
        for lag in range(input_lags):
            for i in range(inputs):
                total += parameters[output_lags + lag * inputs + i] * u[k - delays[i] - lag, i]
        # A diverged simulation stays so: NaN would look like a row without a prediction.
        own[k] = min(max(total, -_DIVERGED), _DIVERGED) if total == total else _DIVERGED
        run[k] = own[k] if abs(own[k]) < _DIVERGED else np.inf
    return run


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
def predict_with_gradient(
    theta: NDArray[np.float64],
    orders: tuple[int, int, NDArray[np.int64], int],
    u: NDArray[np.float64],
    y: NDArray[np.float64],
    plan: PlanArrays,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Predict one output one step ahead, with derivatives.

    Args:
        theta: f, b, offset if there is one, d and c, shape (parameters,).
        orders: `Structure.orders`, and the number of lags of d and of c: those of the output, or 0.
        u: shape (rows, inputs).
        y: shape (rows,), NaN where nothing was measured.
        plan: rows that are predicted, see `RunPlan.arrays`.

    Returns:
        The prediction, shape (rows,), and its gradient, shape (rows, parameters); NaN and 0 where it does not run.
    """
    (lags, input_lags, delays, noise_lags), (starts, running) = orders, plan
    rows, inputs = u.shape
    size = theta.size
    first_d = size - 2 * noise_lags
    first_c = size - noise_lags
    predicted = np.full(rows, np.nan)
    w, v, e = np.zeros(rows), np.zeros(rows), np.zeros(rows)
    dw = np.zeros((rows, size))
    noise_rows = rows if noise_lags else 0
    dv, de = np.zeros((noise_rows, size)), np.zeros((noise_rows, size))
    gradient = np.zeros((rows, size)) if noise_lags else dw
    for k in range(rows):
        if not running[k]:
            continue
        if starts[k]:
            for back in range(1, lags + 1):
                w[k - back] = y[k - back]
                dw[k - back] = 0.0
            for back in range(1, noise_lags + 1):
                v[k - back] = 0.0
                e[k - back] = 0.0
                dv[k - back] = 0.0
                de[k - back] = 0.0
        for lag in range(lags):
            dw[k, lag] = w[k - 1 - lag]
        for lag in range(input_lags):
            for i in range(inputs):
                dw[k, lags + lag * inputs + i] = u[k - delays[i] - lag, i]
        if first_d > lags + input_lags * inputs:
            dw[k, first_d - 1] = 1.0
        total = 0.0
        for i in range(first_d):
            total += theta[i] * dw[k, i]
        w[k] = total
        for lag in range(lags):
            for i in range(size):
                dw[k, i] += theta[lag] * dw[k - 1 - lag, i]
        if noise_lags == 0:
            predicted[k] = w[k]
            continue
        disturbance = 0.0
        for lag in range(noise_lags):
            disturbance += theta[first_d + lag] * v[k - 1 - lag] + theta[first_c + lag] * e[k - 1 - lag]
            gradient[k, first_d + lag] = v[k - 1 - lag]
            gradient[k, first_c + lag] = e[k - 1 - lag]
        for lag in range(noise_lags):
            for i in range(size):
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
