"""Filter of a state map whose parameters are uncertain, and learned from each row.

State and parameters are filtered together (an extended Kalman filter of both; Ljung, IEEE Trans. Automatic Control 24
(1979) 36, with the gains of the parameters from their covariance). So the variance of an innovation has three parts:
noise of the measurements, uncertainty of the state, and uncertainty of the parameters at this very point of operation.
At a set point that the training has not seen the first rows have wide limits and teach; the errors of a parameter are
the same in many rows, and only a filter that learns them makes the innovations independent, as charts need them.

A row whose standard deviation is above 1.3 times that of the training is an extrapolation. After an input took an
unfamiliar value it is not judged, until 25 rows in succession are none. With familiar inputs the plant should
not be there: such a row is judged with that limit as its standard deviation, and teaches nothing.

While learning is off the uncertainty of the parameters stays in the variances (a consider filter: Schmidt 1966), and
they are not corrected. Their covariance grows by 1 / `MEMORY` a row, but not beyond that of the training on average: so
rows are forgotten, and the uncertainty stays bounded without excitation.

The numbers of a filter are one vector, its belief: learning flag, flag of unfamiliar inputs, rows since they settled,
flags of familiar values of each input, past inputs, state, parameters, covariance of state and parameters. A row is one
compiled function of the belief; constants and results are laid out as in `reactorwatch.kalman.ekf_step`, so one step of
the monitor serves both.
"""

from collections.abc import Sequence
from math import inf, isfinite, nan
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.identification.black_box_model import BlackBoxModel, predict_outputs
from reactorwatch.stored_state import Memory

LARGEST_PREDICTION = 1e12  # of scaled signals, and of their sd, where the model diverges: the charts can still use them
BINS = 64  # intervals of the values of an input, each a quarter of its standard deviation wide
MEMORY = 10_000  # rows after which a row is forgotten
FLAGS = 3  # numbers at the start of a belief: learning flag, flag of unfamiliar inputs, rows since they settled
HEAD = 7  # numbers at the start of the constants: outputs, inputs, lags, delay, terms, degree, rate of forgetting
RATE = 6  # index of the latter; 0: a model that errs, which is never learned, and is corrected by values however far
FAILED, UNJUDGED, JUDGED = -1.0, 0.0, 1.0  # above zero if the row is judged, as in `ekf_step`


@jit
def bin_of(value: float) -> int:
    """Index of the interval of a scaled input."""
    return int(min(max(np.floor(value / 0.25) + BINS // 2, 0.0), BINS - 1.0))


@jit
def filter_row(
    belief: NDArray[np.float64],
    given: NDArray[np.float64],
    constants: NDArray[np.float64],
    after: NDArray[np.float64],
    results: NDArray[np.float64],
) -> float:
    """Filter a row; returns `FAILED`, `UNJUDGED` or `JUDGED`.

    Args:
        belief: flags, familiar values, past inputs (newest first), state, parameters, covariance.
        given: inputs of the row before, inputs, time and two step lengths (not used), measured values, limits: numbers
            of standard deviations beyond which a value does not correct the filter.
        constants: see `constants_of`.
        after: filled with the belief after the row.
        results: filled with prediction, innovation, its standard deviation, normalised innovation, its scale (of
            each output), and the returned number.
    """
    p, m, lags = int(constants[0]), int(constants[1]), int(constants[2])
    delay, terms, degree = int(constants[3]), int(constants[4]), int(constants[5])
    n_x, past, n_u = p * lags, (lags + delay - 1) * m, m * lags
    size = n_x + p * terms
    at = HEAD
    centres, spreads = constants[at : at + p + m], constants[at + p + m : at + 2 * (p + m)]
    at += 2 * (p + m)
    r, q, limit_sd = constants[at : at + p], constants[at + p : at + 2 * p], constants[at + 2 * p : at + 3 * p]
    at += 3 * p
    products = np.empty((terms, degree), np.int64)
    for i in range(terms):
        for k in range(degree):
            products[i, k] = int(constants[at + i * degree + k])
    at += terms * degree
    training = constants[at : at + p * terms]
    after[:] = belief
    at = FLAGS + m * BINS
    inputs, x = after[at : at + past], after[at + past : at + past + n_x]
    theta = after[at + past + n_x : at + past + size].reshape((p, terms))
    P = after[at + past + size :].reshape((size, size))
    for i in range(n_u):
        if after[FLAGS + (i % m) * BINS + bin_of(inputs[past - n_u + i])] == 0.0:
            after[1], after[2] = 1.0, 0.0
    signals, values, slopes = np.empty(n_x + n_u), np.empty(terms), np.empty((terms, n_x))
    predicted, jacobian, moved = np.empty(p), np.empty((p, n_x)), np.zeros((p, size))
    signals[:n_x] = x
    signals[n_x:] = inputs[past - n_u :]
    predict_outputs(theta, signals, products, values, slopes, predicted, jacobian)
    for j in range(p):
        for i in range(n_x):
            for c in range(size):
                moved[j, c] += jacobian[j, i] * P[i, c]
        for term in range(terms):
            row = n_x + j * terms + term
            for c in range(size):
                moved[j, c] += values[term] * P[row, c]
    for a in range(n_x - 1, p - 1, -1):
        x[a] = x[a - p]
        for c in range(size):
            P[a, c] = P[a - p, c]
    for a in range(size):
        for c in range(n_x - 1, p - 1, -1):
            P[a, c] = P[a, c - p]
    for j in range(p):
        x[j] = predicted[j]
        for c in range(n_x - p):
            P[j, p + c] = P[p + c, j] = moved[j, c]
        for c in range(n_x, size):
            P[j, c] = P[c, j] = moved[j, c]
        for i in range(j + 1):
            variance = 0.0
            for c in range(n_x):
                variance += moved[j, c] * jacobian[i, c]
            for term in range(terms):
                variance += moved[j, n_x + i * terms + term] * values[term]
            P[j, i] = P[i, j] = variance
        P[j, j] += q[j]
    learns = after[0] > 0.0
    if learns:
        share = 0.0
        for i in range(p * terms):
            share += P[n_x + i, n_x + i] / training[i]
        if share < p * terms:
            for a in range(n_x, size):
                for b in range(n_x, size):
                    P[a, b] += constants[RATE] * P[a, b]
    measured, limits, is_within = given[2 * m + 3 : 2 * m + 3 + p], given[2 * m + 3 + p :], True
    for j in range(p):
        variance = P[j, j] + r[j]
        if not (P[j, j] > 0.0 and variance < inf and abs(x[j]) < inf):
            results[5 * p] = FAILED
            return FAILED
        sd = min(np.sqrt(variance), LARGEST_PREDICTION)
        if sd > limit_sd[j]:
            is_within = False
            if after[1] == 0.0:
                sd = limit_sd[j]
        results[j] = centres[j] + spreads[j] * min(max(x[j], -LARGEST_PREDICTION), LARGEST_PREDICTION)
        results[p + j] = measured[j] - results[j]
        results[2 * p + j] = results[4 * p + j] = spreads[j] * sd
        results[3 * p + j] = results[p + j] / results[2 * p + j]
    verdict = JUDGED
    if after[1] != 0.0:
        if not is_within:
            verdict = UNJUDGED
        after[2] = after[2] + 1.0 if is_within else 0.0
        if after[2] >= 25:  # the values of the inputs are familiar
            after[1] = 0.0
            if learns:
                for i in range(n_u):
                    after[FLAGS + (i % m) * BINS + bin_of(inputs[past - n_u + i])] = 1.0
    elif not is_within:
        learns = False
    column, end = np.empty(size), size if learns else n_x
    for j in range(p):
        value = (measured[j] - centres[j]) / spreads[j]
        far = not abs(results[3 * p + j]) <= limits[j]  # also a missing value
        if far and (constants[RATE] > 0.0 or not abs(results[3 * p + j]) < inf):
            continue
        column[:] = P[j]
        S, error = column[j] + r[j], value - x[j]
        for a in range(end):
            gain = column[a] / S
            if a < n_x:
                x[a] += gain * error
            else:
                theta[(a - n_x) // terms, (a - n_x) % terms] += gain * error
            for b in range(a + 1):
                P[a, b] -= gain * column[b]
        if not learns:  # the parameters keep their variances, the state loses its covariance with them
            for a in range(n_x, size):
                for b in range(n_x):
                    P[a, b] -= column[a] / S * column[b]
        for a in range(size):
            for b in range(a):
                P[b, a] = P[a, b]
    for i in range(past - 1, m - 1, -1):
        inputs[i] = inputs[i - m]
    for i in range(m):
        inputs[i] = (given[m + i] - centres[p + i]) / spreads[p + i]
    results[5 * p] = verdict
    return verdict


_FILTER_ROW = Entry(filter_row)


class BlackBoxFilterMemory(Memory):
    """Memory of a filter.

    Attributes:
        belief: state and parameters with their covariance, what was seen of the inputs, and those of the rows before.
        limit_sd: scaled standard deviation of each output beyond which a row is not judged.
        first_rows: the first rows after a restart, until the state is known.
        started: True if it is.
    """

    belief: Array
    limit_sd: Array
    first_rows: list[list[float]] = msgspec.field(default_factory=list)
    started: bool = False


class Prediction(NamedTuple):
    """One-step-ahead prediction of a row.

    Attributes:
        prediction: predicted outputs, in their units.
        sd: standard deviations of the innovations, in the same units.
        judged: True if the model has seen enough of this point of operation.
    """

    prediction: Sequence[float]
    sd: Sequence[float]
    judged: bool


class BlackBoxFilter:
    """Follows one plant by a fitted state map. Rows are one period apart; after a gap call `restart`.

    Args:
        model: the fitted state map.
        memory: memory to go on from, which it updates; None: a new one.

    Raises:
        ValueError: the memory is of another model.

    Attributes:
        memory: what runs, and what is stored.
    """

    def __init__(self, model: BlackBoxModel, memory: BlackBoxFilterMemory | None = None) -> None:
        self.model, shape = model, model.shape
        self._shape, self._p, self._m = shape, shape.outputs, shape.inputs
        self._past, self._size = shape.past * shape.inputs, shape.states + shape.parameters
        self.constants = constants_of(model)
        self._first = FLAGS + self._m * BINS
        size = self._first + self._past + self._size + self._size**2
        self.memory = memory or BlackBoxFilterMemory(np.zeros(size), np.full(self._p, inf))
        if self.memory.belief.shape != (size,):
            raise ValueError(f"the memory must have {size} numbers, got {self.memory.belief.size}")
        self.belief: Array = self.memory.belief
        self.limit_sd = self.memory.limit_sd
        self._theta, self._P = self._views()
        self._after = np.empty_like(self.belief)
        self._given = np.zeros(2 * self._m + 3 + 2 * self._p)
        self._results = np.empty(5 * self._p + 1)
        if memory is None:
            self.belief[0] = 1.0
            self.reset_parameters()

    def _views(self) -> tuple[Array, Array]:
        first = self._first + self._past + self._shape.states
        theta = self.belief[first : first + self._shape.parameters]
        return theta, self.belief[self._first + self._past + self._size :].reshape(self._size, self._size)

    @property
    def learning(self) -> bool:
        """True if the parameters are learned from the rows."""
        return bool(self.belief[0])

    @learning.setter
    def learning(self, learning: bool) -> None:
        self.belief[0] = float(learning)

    @property
    def parameters(self) -> tuple[Array, Array]:
        """Copies of the parameters and their covariance."""
        n_x = self._shape.states
        return self._theta.copy(), self._P[n_x:, n_x:].copy()

    def reset_parameters(self, parameters: tuple[Array, Array] | None = None) -> None:
        """Set the parameters and their covariance, without correlation with the state.

        Args:
            parameters: see `parameters`; None: those of the training.
        """
        theta, covariance = parameters or (self.model.theta.ravel(), self.model.covariance)
        n_x = self._shape.states
        self._theta[:] = theta
        self._P[n_x:, n_x:], self._P[:n_x, n_x:], self._P[n_x:, :n_x] = covariance, 0.0, 0.0

    def restart(self) -> None:
        """Start with the next rows: rows are missing, or the plant's clock was set. The parameters stay."""
        self.memory.started = False
        self.memory.first_rows.clear()

    def update(self, inputs: Sequence[float], measured: Sequence[float], limits: Sequence[float]) -> Prediction | None:
        """Predict a row, then learn from it; None where there is no prediction.

        Args:
            inputs: inputs that hold from this row on; NaN: unknown, so the filter restarts.
            measured: one value an output; NaN: missing.
            limits: for each output the number of standard deviations beyond which its value corrects nothing.
        """
        prediction = None
        if self.memory.started:
            m, p = self._m, self._p
            self._given[m : 2 * m] = inputs
            self._given[2 * m + 3 : 2 * m + 3 + p], self._given[2 * m + 3 + p :] = measured, limits
            verdict = _FILTER_ROW.call(self.belief, self._given, self.constants, self._after, self._results)
            if verdict == FAILED:
                self.restart()
                self.reset_parameters()
            else:
                self.belief[:] = self._after
                results = self._results.tolist()
                prediction = Prediction(results[:p], results[2 * p : 3 * p], verdict == JUDGED)
        if not self.memory.started:
            self._start(inputs, measured)
        elif not isfinite(sum(inputs)):
            self.restart()
        return prediction

    def _start(self, inputs: Sequence[float], measured: Sequence[float]) -> None:
        """Collect rows until the state is known."""
        if not isfinite(sum(inputs) + sum(measured)):
            self.memory.first_rows.clear()
            return
        shape, p = self._shape, self._p
        self.memory.first_rows.append([*measured, *inputs])
        if len(self.memory.first_rows) < shape.past:
            return
        centres, spreads = np.array(self.model.centres), np.array(self.model.spreads)
        rows = (np.array(self.memory.first_rows[::-1]) - centres) / spreads
        n_x = shape.states
        first = self._first + self._past
        self.belief[self._first : first] = rows[:, p:].ravel()
        self.belief[first : first + n_x] = rows[: shape.lags, :p].ravel()
        self.belief[1:FLAGS] = 0.0
        self._P[:n_x], self._P[:, :n_x] = 0.0, 0.0
        self._P[range(n_x), range(n_x)] = np.tile(self.model.r, shape.lags)
        self.memory.first_rows.clear()
        self.memory.started = True

    def run(self, inputs: Array, outputs: Array, follows: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Predict the rows of the training with its own parameters, then stand at its end, ready to learn.

        1.3 times the typical standard deviation of these rows becomes the limit beyond which a row is an extrapolation.

        Args:
            inputs: shape (rows, inputs).
            outputs: shape (rows, outputs).
            follows: True where a row is one period after the row before.

        Returns:
            Residuals, NaN where there is no prediction, and their standard deviations; each of shape (rows, outputs).
        """
        theta, covariance = self.parameters
        self.restart()
        self.reset_parameters((theta, np.zeros_like(covariance)))
        self.learning = False
        self.limit_sd = np.full(self._p, inf)
        p, centres, spreads = self._p, self.model.centres, self.model.spreads
        for i, column in enumerate(inputs.T):
            for value in column[np.isfinite(column)].tolist():
                self.belief[FLAGS + i * BINS + bin_of((value - centres[p + i]) / spreads[p + i])] = 1.0
        residuals, sds = np.full(outputs.shape, nan), np.full(outputs.shape, nan)
        unlimited = [inf] * self._p
        for k, (row_inputs, values) in enumerate(zip(inputs.tolist(), outputs.tolist(), strict=True)):
            if not follows[k]:
                self.restart()
            predicted = self.update(row_inputs, values, unlimited)
            if predicted is not None:
                residuals[k], sds[k] = np.subtract(values, predicted.prediction), predicted.sd
        self.reset_parameters((theta, covariance))
        self.learning = True
        if np.isfinite(sds).any():
            self.limit_sd = 1.3 * np.nanmedian(sds, axis=0) / np.array(self.model.spreads[: self._p])
        return residuals, sds

    @property
    def limit_sd(self) -> Array:
        """Scaled standard deviation of each output beyond which a row is not judged."""
        return self.memory.limit_sd

    @limit_sd.setter
    def limit_sd(self, limits: Array) -> None:
        first = HEAD + 2 * (self._p + self._m) + 2 * self._p
        self.memory.limit_sd = self.constants[first : first + self._p] = limits


def constants_of(model: BlackBoxModel) -> Array:
    """Constants of `filter_row`: sizes, scaling, variances, limits (infinite), products, the parameters' variances."""
    shape = model.shape
    head = [shape.outputs, shape.inputs, shape.lags, shape.delay, shape.terms, shape.degree, 1.0 / MEMORY]
    limits, products, variances = np.full(shape.outputs, inf), shape.products().ravel(), np.diag(model.covariance)
    numbers = (head, model.centres, model.spreads, model.r, model.q, limits, products, variances)
    return np.concatenate([np.asarray(item, dtype=np.float64) for item in numbers])
