"""Prediction errors of a state map with a constant gain, their sensitivities, and the likelihood of its filter.

With the gain 0 the state is a simulation: noise of the measurements does not enter the regressors, so it leaves no bias
(least squares on noisy lags has one). With the gain 1 it is the measured row, as in an ARX model.
"""

from math import inf
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.identification.black_box.model import predict_outputs

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
        products: see `model.Shape.products`.
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
