"""One-step prediction of a linear plant with a model of its disturbance, and its gradient.

    w[k] = f1 w[k-1] + ... + fn w[k-n] + b1 u[k-d] + ... + bn u[k-d-n+1] + offset      the plant
    v[k] = d1 v[k-1] + ... + dn v[k-n] + e[k] + c1 e[k-1] + ... + cn e[k-n]            its disturbance
    y[k] = w[k] + v[k]

with e white. A Box-Jenkins model has all of these parameters, several inputs share the poles f. An ARMAX model is the
same with f = d = a, and an output-error model has neither d nor c: its prediction is its simulation (Ljung, System
Identification, 2nd ed., section 4.2). The gradient is exact: the recursions are differentiated, in one pass, the start
of the run taken into account (section 10.3).

A run starts from measured rows with e = 0; what this does dies out as the poles, or the zeros of the disturbance, do.
At a missing output the prediction continues with e = 0.
"""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.identification.simulation import PlanArrays, RunPlan
from reactorwatch.identification.structure import Structure

Kind = Literal["arx", "oe", "armax", "bj"]
"""Kind of a model; `oe` is output error, `bj` is Box-Jenkins."""


class LinearPredictor:
    """Parameters of a kind of model.

    Args:
        kind: kind of the model.
        structure: terms of the plant; the disturbance has as many lags as the output.

    Attributes:
        index: indices of f, b, offset, d and c among the parameters; an ARMAX model uses `a` for both f and d.
        noise_lags: number of lags of d and of c.
        size: number of parameters.
    """

    def __init__(self, kind: Kind, structure: Structure) -> None:
        self.structure, plant, lags = structure, structure.parameters, structure.output_lags
        self.noise_lags = lags if kind in ("armax", "bj") else 0
        self.index = np.arange(plant + 2 * self.noise_lags)
        if kind == "armax":
            order = np.arange(plant + lags)
            self.index = np.concatenate([order[:plant], order[:lags], order[plant:]])
        self.size = int(self.index.max()) + 1

    def split(self, parameters: Array) -> tuple[Array, Array, Array]:
        """Parameters of the plant, and d and c."""
        full, plant = parameters[self.index], self.structure.parameters
        return full[:plant], full[plant : plant + self.noise_lags], full[plant + self.noise_lags :]

    def is_stable(self, parameters: Array) -> bool:
        """True if all poles and the zeros of the disturbance are inside the unit circle."""
        plant, d, c = self.split(parameters)
        polynomials = (plant[: self.structure.output_lags], d, -c)
        return all(bool(is_stable(np.ascontiguousarray(polynomial))) for polynomial in polynomials)


class PredictionErrors:
    """Prediction errors of one record and their gradient; an `Objective`.

    Args:
        predictor: parameters of the model.
        inputs: shape (rows, inputs).
        outputs: shape (rows, 1).
        plan: rows that the prediction covers.
        chosen: rows that may be compared, shape (rows,); None: all.

    Attributes:
        compared: rows whose errors count, shape (rows,).
    """

    def __init__(
        self,
        predictor: LinearPredictor,
        inputs: Array,
        outputs: Array,
        plan: RunPlan,
        chosen: NDArray[np.bool_] | None = None,
    ) -> None:
        self._predictor, self._plan = predictor, plan
        self._inputs, self._outputs = np.ascontiguousarray(inputs), np.ascontiguousarray(outputs[:, 0])
        self.compared = plan.running & np.isfinite(self._outputs)
        if chosen is not None:
            self.compared &= chosen

    def predict(self, theta: Array) -> tuple[Array, Array]:
        """Prediction, shape (rows,), and its gradient, shape (rows, parameters); NaN and 0 where it does not run."""
        index, orders = self._predictor.index, (*self._predictor.structure.orders, self._predictor.noise_lags)
        predicted, full = predict_with_gradient(theta[index], orders, self._inputs, self._outputs, self._plan.arrays)
        if index.size == self._predictor.size:
            return predicted, full
        gradient = np.zeros((full.shape[0], self._predictor.size))
        for column, i in enumerate(index):
            gradient[:, i] += full[:, column]
        return predicted, gradient

    def __call__(self, theta: Array) -> tuple[Array, Array]:
        """Errors, shape (compared rows,), and the gradient of the prediction, shape (compared rows, parameters)."""
        predicted, gradient = self.predict(theta)
        return (self._outputs - predicted)[self.compared], gradient[self.compared]

    def admits(self, theta: Array) -> bool:
        """True if all poles and the zeros of the disturbance are inside the unit circle."""
        return self._predictor.is_stable(theta)


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
    orders: tuple[int, int, int, int],
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
    (lags, input_lags, delay, noise_lags), (starts, running) = orders, plan
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
                dw[k, lags + lag * inputs + i] = u[k - delay - lag, i]
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
