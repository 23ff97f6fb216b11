"""Error dynamics of a filter: the effect of small deviations on its innovations.

A deviation that the model lacks makes the filter's state wrong, and so its predictions. With e the error of the state
and m the size of the deviation, between two rows and at a row

    e <- F e + G m,        innovation = H e + D m,        e <- e - K innovation,

with F and G the derivatives of the state's transition, H and D those of the outputs, and K the filter's gain. All is
linearised about the filter's run; long intervals are predicted in pieces. It is machine code that takes row after row:
a thousand rows cost a millisecond.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from math import ceil

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import LANES, CompiledFunction
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.kalman.batch import LONGEST_ROW_MIN, InputUncertainty
from reactorwatch.kalman.ekf_step import NoiseLevels, transition
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import LONGEST_STEP_MIN, compiled_outputs


@dataclass(frozen=True, eq=False)
class ErrorDynamics:
    """Linear equations of the intervals between rows, along the first axis; contiguous except G and D of some sizes.

    Attributes:
        F: d state / d state before, shape (n_x, n_x).
        G: d state / d sizes, shape (n_x, sizes).
        H: d outputs / d state, shape (n_y, n_x).
        D: d outputs / d sizes, shape (n_y, sizes).
        K: filter gain, shape (n_x, n_y).
        whitening: inverse Cholesky factor of the innovation's covariance, shape (n_y, n_y); 0 where nothing was
            measured.
        w: normalised innovation, shape (n_y,); 0 where nothing was measured.
    """

    F: Array
    G: Array
    H: Array
    D: Array
    K: Array
    whitening: Array
    w: Array


@dataclass(frozen=True, eq=False)
class LinearizedTrajectory:
    """Linear equations along a trajectory; those of intervals have one entry an interval along the first axis.

    Attributes:
        predicted: predicted state at the end of each interval, shape (n_x,).
        F: d predicted / d state before, shape (n_x, n_x).
        G: d predicted / d sizes, shape (n_x, sizes).
        predicted_sd: standard deviation of the prediction from unknown input changes, shape (n_x,).
        outputs: outputs in each row, shape (rows, n_y).
        H: d outputs / d state, shape (rows, n_y, n_x).
        D: d outputs / d sizes, shape (rows, n_y, sizes).
    """

    predicted: Array
    F: Array
    G: Array
    predicted_sd: Array
    outputs: Array
    H: Array
    D: Array


class ErrorLinearization:
    """Linearises the filter of a model about its run over a record.

    Args:
        model: model of the filter.
        noise: noise of the plant and its sensors.
        rate_symbols: symbols of the model, the sizes as they act in the balances.
        output_symbols: symbols of these sizes in the outputs; may be the same symbols.

    Attributes:
        noise: noise of the plant and its sensors.
        changes: parameters that differ from the model's values.
    """

    def __init__(
        self, model: ProcessModel, noise: NoiseLevels, rate_symbols: Sequence[ca.SX], output_symbols: Sequence[ca.SX]
    ) -> None:
        self.model, self.noise = model, noise
        self.changes: Mapping[str, float] = {}
        self._code = _Code(model, tuple(rate_symbols), tuple(output_symbols))

    def with_noise(self, noise: NoiseLevels) -> "ErrorLinearization":
        """Copy with another noise; shares the compiled code."""
        other = copy(self)
        other.noise = noise
        return other

    def dynamics(
        self,
        time_min: Array,
        inputs: Array,
        x: Array,
        P: Array,
        residual: Array,
        used: NDArray[np.bool_],
        began: NDArray[np.bool_] | None = None,
        uncertainty: InputUncertainty | None = None,
    ) -> ErrorDynamics:
        """Error dynamics of a filter's run over a record.

        Args:
            time_min: shape (rows,).
            inputs: shape (rows, n_u).
            x: filtered state, shape (rows, n_x).
            P: filtered covariance, shape (rows, n_x, n_x).
            residual: innovations, shape (rows, n_y); NaN where nothing was measured.
            used: measurements that corrected the filter, shape (rows, n_y).
            began: rows at which the filter restarted, which forget all but constant states, shape (rows,); None: none.
            uncertainty: intervals in which inputs changed at an unknown time; None: there are none.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # where the filter has diverged from an unstable plant
            R, q = np.square(self.noise.measurement_sd), np.square(self.noise.process_sd)
            p = self.model.values(self.changes)
            predicted, F, G, spread = self._predict(x[:-1], inputs[:-1], time_min, p, uncertainty)
            H, D = self._code.outputs_by.map(predicted, inputs[1:], p, time_min[1:])
            P, residual = np.ascontiguousarray(P), np.ascontiguousarray(residual)  # one kernel is compiled for all
            R = np.tile(R, (len(F), 1)) + self._code.noise_beyond(inputs[1:], p, time_min[1:])
            whitening, w, K = _normalize(F, H, P, q, np.diff(time_min), spread, R, residual, used)
        if began is not None:
            restarted = began[1:, None, None]
            kept = np.zeros(F.shape[1:])
            kept[self.model.constant_states, self.model.constant_states] = 1.0
            F = np.where(restarted, kept, F)
            G, H, D, K = (np.where(restarted, 0.0, item) for item in (G, H, D, K))
        items = (F, G, H, D, K, whitening, w)
        return ErrorDynamics(*(np.ascontiguousarray(item) for item in items))  # once, for all kernels

    def prepare(self) -> None:
        """Compile now what `dynamics` needs, by calls with one row and with more rows than lanes."""
        n_x, n_u, n_y = len(self.model.states), len(self.model.inputs), len(self.model.outputs)
        for rows in (2, LANES + 1):
            x = np.tile([state.scale for state in self.model.states], (rows, 1))
            P, nothing = np.tile(np.eye(n_x), (rows, 1, 1)), np.zeros((rows, n_y))
            time_min = np.linspace(0.0, LONGEST_STEP_MIN, rows)
            self.dynamics(time_min, np.ones((rows, n_u)), x, P, nothing, np.zeros((rows, n_y), dtype=np.bool_))

    def along(
        self, time_min: Array, inputs: Array, x: Array, uncertainty: InputUncertainty | None = None
    ) -> "LinearizedTrajectory":
        """Linearise along a trajectory that need not be a filter's.

        Args:
            time_min: shape (rows,).
            inputs: shape (rows, n_u).
            x: states, shape (rows, n_x).
            uncertainty: intervals in which inputs changed at an unknown time; None: there are none.
        """
        p = self.model.values()
        predicted, F, G, spread = self._predict(x[:-1], inputs[:-1], time_min, p, uncertainty)
        H, D = self._code.outputs_by.map(x, inputs, p, time_min)
        (y,) = compiled_outputs(self.model).map(x, inputs, p, time_min)
        sd = np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
        return LinearizedTrajectory(predicted, F, G, sd, y[:, :, 0], H, D)

    def _predict(
        self, x: Array, u: Array, time_min: Array, p: Array, uncertainty: InputUncertainty | None
    ) -> tuple[Array, Array, Array, Array]:
        """Predicted states, their derivatives, and their covariance from unknown input changes."""
        t, step = time_min[:-1], np.diff(time_min)
        predicted, F, G = self._predict_rows(x, u, t, step, p)
        spread = np.zeros((*predicted.shape, predicted.shape[1]))
        if uncertainty is not None:
            intervals = uncertainty.select(slice(1, None))
            for n_times in np.unique(intervals.n_times[intervals.rows]).tolist():
                rows = np.flatnonzero(intervals.n_times == n_times)
                held = (predicted[rows], F[rows], G[rows])
                ends = self._predict_uncertain(
                    x[rows], u[rows], time_min[rows], time_min[rows + 1], p, intervals, rows, held
                )
                predicted[rows], F[rows], G[rows] = (np.mean(item, axis=0) for item in ends)
                deviation = ends[0] - predicted[rows]
                spread[rows] = np.einsum("mki,mkj->kij", deviation, deviation) / n_times
        return predicted, F, G, spread

    def _predict_uncertain(
        self,
        x: Array,
        u: Array,
        begin_min: Array,
        end_min: Array,
        p: Array,
        uncertainty: InputUncertainty,
        rows: NDArray[np.intp],
        unchanged: tuple[Array, Array, Array],
    ) -> tuple[Array, Array, Array]:
        """Predictions and derivatives for each possible time of the change, along the first axis."""
        ends: list[tuple[Array, Array, Array]] = []
        for time in np.linspace(uncertainty.first_min[rows], uncertainty.last_min[rows], uncertainty.n_times[rows[0]]):
            changed = np.clip(time, begin_min, end_min)
            if np.array_equal(changed, end_min):
                ends.append(unchanged)
                continue
            held, F, G = self._predict_rows(x, u, begin_min, changed - begin_min, p)
            predicted, of_x, of_size = self._predict_rows(held, uncertainty.inputs[rows], changed, end_min - changed, p)
            ends.append((predicted, of_x @ F, of_x @ G + of_size))
        predicted, F, G = (np.stack(items) for items in zip(*ends, strict=True))
        return predicted, F, G

    def _predict_rows(self, x: Array, u: Array, t: Array, step: Array, p: Array) -> tuple[Array, Array, Array]:
        pieces = np.maximum(np.ceil(step / LONGEST_ROW_MIN), 1.0)
        predicted, F, G = self._code.piece.map(x, u, p, t, step / pieces)
        predicted = predicted[:, :, 0]
        for i in range(1, ceil(pieces.max())):
            rows = np.flatnonzero(pieces > i)
            length = step[rows] / pieces[rows]
            after, of_x, of_size = self._code.piece.map(predicted[rows], u[rows], p, t[rows] + i * length, length)
            predicted[rows], F[rows], G[rows] = after[:, :, 0], of_x @ F[rows], of_x @ G[rows] + of_size
        return predicted, F, G


@dataclass(frozen=True, eq=False)
class _Code:
    """Functions that are compiled at their first use."""

    model: ProcessModel
    rate_symbols: tuple[ca.SX, ...]
    output_symbols: tuple[ca.SX, ...]

    @cached_property
    def piece(self) -> CompiledFunction:
        return CompiledFunction(piece_function(self.model, self.rate_symbols), shared=[2])

    @cached_property
    def outputs_by(self) -> CompiledFunction:
        return CompiledFunction(output_derivatives(self.model, self.output_symbols), shared=[2])

    def noise_beyond(self, inputs: Array, p: Array, time_min: Array) -> Array | float:
        """Variances of the sensors' noise beyond the usual, shape (rows, n_y), or 0."""
        return 0.0 if self._noise is None else self._noise.map(inputs, p, time_min)[0][:, :, 0]

    @cached_property
    def _noise(self) -> CompiledFunction | None:
        function = self.model.noise_function()
        return None if function is None else CompiledFunction(function, shared=[1])


@jit
def _normalize(
    F: Array,
    H: Array,
    P: Array,
    q: Array,
    step: Array,
    spread: Array,
    R: Array,
    residual: Array,
    used: NDArray[np.bool_],
) -> tuple[Array, Array, Array]:
    """Whitening matrix, normalised innovation and gain of each interval; R has the shape (intervals, n_y).

    Where the filter has diverged these are meaningless; pivots are kept positive.
    """
    count, n_x, n_y = F.shape[0], F.shape[1], H.shape[1]
    whitening, w, K = np.zeros((count, n_y, n_y)), np.zeros((count, n_y)), np.zeros((count, n_x, n_y))
    FP, prior, HP = np.zeros((n_x, n_x)), np.zeros((n_x, n_x)), np.zeros((n_y, n_x))
    S, L, present = np.zeros((n_y, n_y)), np.zeros((n_y, n_y)), np.zeros(n_y, dtype=np.bool_)
    for k in range(count):
        for i in range(n_x):
            for j in range(n_x):
                value = 0.0
                for m in range(n_x):
                    value += F[k, i, m] * P[k, m, j]
                FP[i, j] = value
        for i in range(n_x):
            for j in range(n_x):
                value = spread[k, i, j]
                if i == j:
                    value += q[i] * step[k]
                for m in range(n_x):
                    value += FP[i, m] * F[k, j, m]
                prior[i, j] = value
        for i in range(n_y):
            for j in range(n_x):
                value = 0.0
                for m in range(n_x):
                    value += H[k, i, m] * prior[m, j]
                HP[i, j] = value
        for i in range(n_y):
            present[i] = np.isfinite(residual[k + 1, i])
            for j in range(n_y):
                value = R[k, i] if i == j else 0.0
                for m in range(n_x):
                    value += HP[i, m] * H[k, j, m]
                S[i, j] = value
                present[i] = present[i] and np.isfinite(value)
        for i in range(n_y):
            for j in range(n_y):
                if not (present[i] and present[j]):
                    S[i, j] = 1.0 if i == j else 0.0
        for i in range(n_y):
            for j in range(i + 1):
                value = S[i, j]
                for m in range(j):
                    value -= L[i, m] * L[j, m]
                L[i, j] = np.sqrt(max(value, 1e-12 * abs(S[i, i]))) if i == j else value / L[j, j]
        for j in range(n_y):  # column by column of the inverse; 0 where nothing was measured
            for i in range(j, n_y):
                value = 1.0 if i == j else 0.0
                for m in range(j, i):
                    value -= L[i, m] * whitening[k, m, j]
                whitening[k, i, j] = value / L[i, i] if present[i] and present[j] else 0.0
        for i in range(n_y):
            for j in range(i + 1):
                if present[j]:
                    w[k, i] += whitening[k, i, j] * residual[k + 1, j]
        for i in range(n_x):
            for j in range(n_y):
                if used[k + 1, j]:
                    value = 0.0
                    for m in range(n_x):
                        value += P[k + 1, i, m] * H[k, j, m]
                    K[k, i, j] = value / R[k, j]
    return whitening, w, K


def piece_function(model: ProcessModel, sizes: Sequence[ca.SX]) -> ca.Function:
    """(x, u, p, t, h) -> x after two steps, and its derivatives with respect to x and the sizes."""
    x, u, p = model.arguments()
    t, h = ca.SX.sym("t"), ca.SX.sym("h")
    half = 0.5 * h
    results = transition(model, (x, u, p), ((t, half), (t + half, half)), ca.vertcat(*sizes))
    return ca.Function("piece", [x, u, p, t, h], [ca.densify(item) for item in ca.cse(list(results))])


def output_derivatives(model: ProcessModel, sizes: Sequence[ca.SX]) -> ca.Function:
    """(x, u, p, t) -> derivatives of the outputs with respect to x and the sizes."""
    x, u, p, t, y = model.output_expressions()
    by = [ca.densify(ca.jacobian(y, item)) for item in (x, ca.vertcat(*sizes))]
    return ca.Function("shown", [x, u, p, t], ca.cse(by))
