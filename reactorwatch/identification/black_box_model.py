"""Polynomial state map x[k+1] = f(x[k], u[k]) of the newest outputs, its prediction errors and their likelihood.

The signals of a row are the outputs of the last `lags` rows, the newest first, then as many lagged inputs. Each output
of the next row is a linear combination of products of these signals, up to a degree. Signals are scaled by mean and
spread of the training.

The prediction errors of a training have a constant gain. With the gain 0 the state is a simulation: noise of the
measurements does not enter the regressors, so it leaves no bias (least squares on noisy lags has one). With the gain 1
it is the measured row, as in an ARX model.
"""

from dataclasses import dataclass
from math import inf
from typing import Self, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.identification.polynomial import factors_of, products_of
from reactorwatch.stored_state import pack_numbers, unpack_numbers


@dataclass(frozen=True)
class Shape:
    """Shape of a state map.

    Attributes:
        outputs: number of outputs.
        inputs: number of inputs.
        lags: rows of outputs, and of inputs, on which the next row depends.
        degree: largest number of factors of a product.
        delay: delay of the inputs in rows; with 1 they act on the next row.
    """

    outputs: int
    inputs: int
    lags: int
    degree: int
    delay: int = 1

    @property
    def states(self) -> int:
        """Number of states."""
        return self.outputs * self.lags

    @property
    def signals(self) -> int:
        """Number of factors that a product can have."""
        return (self.outputs + self.inputs) * self.lags

    @property
    def past(self) -> int:
        """Number of rows of which the inputs are needed."""
        return self.lags + self.delay - 1

    @property
    def terms(self) -> int:
        """Number of terms of an output."""
        return len(self.products())

    @property
    def parameters(self) -> int:
        """Number of parameters of all outputs."""
        return self.outputs * self.terms

    def products(self) -> NDArray[np.int64]:
        """Factors of all products, see `polynomial.factors_of`."""
        return factors_of(products_of(self.signals, self.degree))


class BlackBoxModel(msgspec.Struct, frozen=True):
    """Fitted state map. Everything but centres and spreads is of scaled signals.

    Attributes:
        outputs: number of outputs.
        inputs: number of inputs.
        lags: rows of outputs and inputs on which the next row depends.
        degree: largest degree of the polynomial.
        delay: delay of the inputs in rows.
        rows: number of rows of the fit.
        effective: number of parameters of an output that the rows determine, not the prior.
        gain: gain of the fit: 0, simulation errors; 1, errors of the next row.
        centres: means of the outputs, then of the inputs, in the signals' units.
        spreads: standard deviations of the same.
        r: variances of the measurements of each output.
        q: variances of the process from row to row, of each output.
        numbers: parameters and the lower triangle of their covariance, as doubles.
    """

    outputs: int
    inputs: int
    lags: int
    degree: int
    delay: int
    rows: int
    effective: float
    gain: float
    centres: tuple[float, ...]
    spreads: tuple[float, ...]
    r: tuple[float, ...]
    q: tuple[float, ...]
    numbers: bytes

    @classmethod
    def of(
        cls,
        shape: Shape,
        rows: int,
        effective: float,
        gain: float,
        scaling: tuple[Array, Array],
        variances: tuple[Array, Array],
        theta: Array,
        covariance: Array,
    ) -> Self:
        """Make a model of arrays: centres and spreads, r and q, and parameters, shape (outputs, terms)."""
        lower = covariance[np.tril_indices(theta.size)]
        centres, spreads, r, q = (tuple(item.tolist()) for item in (*scaling, *variances))
        numbers = pack_numbers(np.concatenate([theta.ravel(), lower]))
        sizes = (shape.outputs, shape.inputs, shape.lags, shape.degree, shape.delay)
        return cls(*sizes, rows, effective, gain, centres, spreads, r, q, numbers)

    def scale_sds(self, factor: float) -> Self:
        """The same model with standard deviations that are larger by a factor; its predictions are the same."""
        variances = factor**2 * np.array(self.r), factor**2 * np.array(self.q)
        scaling = np.array(self.centres), np.array(self.spreads)
        covariance = factor**2 * self.covariance
        return self.of(self.shape, self.rows, self.effective, self.gain, scaling, variances, self.theta, covariance)

    @property
    def shape(self) -> Shape:
        """Shape of the map."""
        return Shape(self.outputs, self.inputs, self.lags, self.degree, self.delay)

    @property
    def theta(self) -> Array:
        """Parameters, shape (outputs, terms)."""
        return self._numbers[: self.shape.parameters].reshape(self.outputs, -1)

    @property
    def covariance(self) -> Array:
        """Covariance of the parameters, shape (parameters, parameters)."""
        count = self.shape.parameters
        covariance = np.zeros((count, count))
        covariance[np.tril_indices(count)] = self._numbers[count:]
        return covariance + np.tril(covariance, -1).T

    @property
    def error_sd(self) -> Array:
        """Standard deviation of each output's one-step error with known parameters and state, in its unit."""
        return np.asarray(np.sqrt(np.add(self.r, self.q)) * np.array(self.spreads[: self.outputs]))

    @property
    def out_of_sample(self) -> float:
        """Ratio of the size of residuals out of the fit to that of residuals in it."""
        return float(np.sqrt(self.rows / max(self.rows - self.effective, 0.1 * self.rows)))

    @property
    def dynamics_sd(self) -> float:
        """Largest standard deviation of a coefficient by which an output depends on a state, of scaled signals."""
        variances = np.diag(self.covariance)  # rounding may make those of what is not determined negative
        deviations = np.sqrt(np.where(variances >= 0.0, variances, np.inf)).reshape(self.outputs, -1)
        return float(np.max(deviations[:, 1 : 1 + self.shape.states]))

    @property
    def _numbers(self) -> Array:
        count = self.shape.parameters
        numbers = unpack_numbers(self.numbers, 1)[:, 0]
        if numbers.size != count + count * (count + 1) // 2:
            raise ValueError(f"a model of {count} parameters must have a covariance of that size, got {numbers.size}")
        return numbers


def lagged_inputs(shape: Shape, inputs: Array) -> Array:
    """Inputs on which the row after each row depends, newest first, shape (rows, inputs lags); NaN where unknown."""
    rows = len(inputs)
    lagged = np.full((rows, shape.inputs * shape.lags), np.nan)
    for lag in range(shape.lags):
        shift = shape.delay - 1 + lag
        lagged[shift:, lag * shape.inputs : (lag + 1) * shape.inputs] = inputs[: rows - shift]
    return lagged


@jit
def predict_outputs(
    theta: NDArray[np.float64],
    signals: NDArray[np.float64],
    products: NDArray[np.int64],
    values: NDArray[np.float64],
    slopes: NDArray[np.float64],
    outputs: NDArray[np.float64],
    jacobian: NDArray[np.float64],
) -> None:
    """Outputs of the next row and their derivatives by the states.

    Args:
        theta: parameters, shape (outputs, terms).
        signals: scaled signals, the states first.
        products: see `Shape.products`.
        values: filled with the products, shape (terms,).
        slopes: filled with their derivatives by the states, shape (terms, states).
        outputs: filled, shape (outputs,).
        jacobian: filled, shape (outputs, states).
    """
    terms, degree = products.shape
    states = slopes.shape[1]
    for term in range(terms):
        value = 1.0
        for i in range(degree):
            if products[term, i] >= 0:
                value *= signals[products[term, i]]
        values[term] = value
        for state in range(states):
            slopes[term, state] = 0.0
        for i in range(degree):
            factor = products[term, i]
            if 0 <= factor < states:
                others = 1.0
                for k in range(degree):
                    if k != i and products[term, k] >= 0:
                        others *= signals[products[term, k]]
                slopes[term, factor] += others
    for j in range(theta.shape[0]):
        total = 0.0
        for term in range(terms):
            total += theta[j, term] * values[term]
        outputs[j] = total
        for i in range(states):
            total = 0.0
            for term in range(terms):
                total += theta[j, term] * slopes[term, i]
            jacobian[j, i] = total


START, NEXT = 1, 2
"""Kinds of a row: the state is set from its measurements; it follows the row before. 0: it is left out."""

DIVERGED = 50.0
"""Scaled output beyond which a simulation has diverged."""

RowArrays: TypeAlias = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]
"""Scaled outputs, shape (rows, outputs), NaN where missing; scaled lagged inputs, shape (rows, inputs lags); kinds of
the rows, shape (rows,)."""


@jit
def prediction_errors(
    theta: NDArray[np.float64],
    products: NDArray[np.int64],
    states: int,
    rows: RowArrays,
    gain: float,
    weights: NDArray[np.float64],
    errors: NDArray[np.float64],
    gram: NDArray[np.float64],
    slope: NDArray[np.float64],
) -> bool:
    """Errors of the predictions, and the equations of a Gauss-Newton step; returns False if it diverged.

    Args:
        theta: parameters, shape (outputs, terms).
        products: see `Shape.products`.
        states: number of states.
        rows: rows of the training.
        gain: share of an error that corrects the state.
        weights: weight of each output's squares, shape (outputs,).
        errors: filled, shape (rows, outputs); NaN where there is none.
        gram: filled, shape (parameters, parameters); of size 0: no equations are made.
        slope: filled, shape (parameters,).
    """
    y, u, kinds = rows
    count, outputs = y.shape
    terms, parameters = theta.shape[1], theta.size
    inputs, is_wanted = u.shape[1], gram.size > 0
    lags = states // outputs
    signals, values, slopes = np.zeros(states + inputs), np.zeros(terms), np.zeros((terms, states))
    predicted, jacobian = np.zeros(outputs), np.zeros((outputs, states))
    sensitivity, new = np.zeros((states, parameters)), np.zeros((outputs, parameters))
    gram[:], slope[:], errors[:] = 0.0, 0.0, np.nan
    for k in range(count):
        if kinds[k] == START:
            sensitivity[:] = 0.0
            for lag in range(lags):
                for j in range(outputs):
                    signals[lag * outputs + j] = y[k - lag, j]
        if kinds[k] != NEXT:
            continue
        for i in range(inputs):
            signals[states + i] = u[k - 1, i]
        predict_outputs(theta, signals, products, values, slopes, predicted, jacobian)
        for j in range(outputs):
            if not abs(predicted[j]) < DIVERGED:
                return False
        if is_wanted:
            new[:] = 0.0
            for j in range(outputs):
                for i in range(states):
                    for c in range(parameters):
                        new[j, c] += jacobian[j, i] * sensitivity[i, c]
                for term in range(terms):
                    new[j, j * terms + term] += values[term]
            for i in range(states - 1, outputs - 1, -1):
                for c in range(parameters):
                    sensitivity[i, c] = sensitivity[i - outputs, c]
        for i in range(states - 1, outputs - 1, -1):
            signals[i] = signals[i - outputs]
        for j in range(outputs):
            error, share = y[k, j] - predicted[j], 0.0
            signals[j] = predicted[j]
            if abs(error) < inf:
                errors[k, j], share = error, gain
                signals[j] += gain * error
                if is_wanted:
                    for a in range(parameters):
                        weighted = weights[j] * new[j, a]
                        slope[a] += weighted * error
                        for b in range(a + 1):
                            gram[a, b] += weighted * new[j, b]
            if is_wanted:
                for c in range(parameters):
                    sensitivity[j, c] = (1.0 - share) * new[j, c]
    for a in range(gram.shape[0]):
        for b in range(a):
            gram[b, a] = gram[a, b]
    return True


@jit
def log_likelihood(
    theta: NDArray[np.float64],
    products: NDArray[np.int64],
    states: int,
    rows: RowArrays,
    r: NDArray[np.float64],
    q: NDArray[np.float64],
) -> float:
    """Log-likelihood of the rows by the extended Kalman filter of a state map with known parameters.

    Args:
        theta: see `prediction_errors`.
        products: see `prediction_errors`.
        states: see `prediction_errors`.
        rows: see `prediction_errors`.
        r: variances of the measurements, shape (outputs,).
        q: variances of the process from row to row, shape (outputs,).
    """
    y, u, kinds = rows
    count, outputs = y.shape
    terms, inputs = theta.shape[1], u.shape[1]
    lags, total = states // outputs, 0.0
    signals, values, slopes = np.zeros(states + inputs), np.zeros(terms), np.zeros((terms, states))
    predicted, jacobian = np.zeros(outputs), np.zeros((outputs, states))
    P, moved, K = np.zeros((states, states)), np.zeros((outputs, states)), np.zeros(states)
    for k in range(count):
        if kinds[k] == START:
            P[:] = 0.0
            for lag in range(lags):
                for j in range(outputs):
                    signals[lag * outputs + j] = y[k - lag, j]
                    P[lag * outputs + j, lag * outputs + j] = r[j]
        if kinds[k] != NEXT:
            continue
        for i in range(inputs):
            signals[states + i] = u[k - 1, i]
        predict_outputs(theta, signals, products, values, slopes, predicted, jacobian)
        for j in range(outputs):
            if not abs(predicted[j]) < DIVERGED:
                return -inf
            for c in range(states):
                moved[j, c] = 0.0
                for i in range(states):
                    moved[j, c] += jacobian[j, i] * P[i, c]
        for a in range(states - 1, outputs - 1, -1):
            for b in range(states - 1, outputs - 1, -1):
                P[a, b] = P[a - outputs, b - outputs]
            signals[a] = signals[a - outputs]
        for j in range(outputs):
            for c in range(states - outputs):
                P[j, outputs + c] = P[outputs + c, j] = moved[j, c]
            for i in range(j + 1):
                variance = 0.0
                for c in range(states):
                    variance += moved[j, c] * jacobian[i, c]
                P[j, i] = P[i, j] = variance
            P[j, j] += q[j]
            signals[j] = predicted[j]
        for j in range(outputs):
            S, error = P[j, j] + r[j], y[k, j] - signals[j]
            if abs(error) < inf:
                total -= 0.5 * (np.log(S) + min(error * error / S, 25.0))  # more is an outlier
                for a in range(states):
                    K[a] = P[a, j]
                for a in range(states):
                    signals[a] += K[a] / S * error
                    for b in range(states):
                        P[a, b] -= K[a] * K[b] / S
    return total
