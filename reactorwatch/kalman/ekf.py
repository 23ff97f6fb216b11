"""The extended Kalman filter of a process model.

Between two rows the state follows the model's equations and its covariance their linearisation: with F the Jacobian of
the state's transition, Q the process noise per minute (see `NoiseLevels`) and h the time between the rows,

    x <- Phi(x, u),    P <- F P F' + Q h,

with the input of the row before, which was held until now. The measurements of a row, whose noise is independent, then
correct it one after the other in Joseph form (Bucy & Joseph 1968, Filtering for Stochastic Processes with Applications
to Guidance), which keeps P symmetric and positive definite over months:

    K = P H' / (H P H' + R),    x <- x + K (y - yhat),    P <- (1 - K H) P (1 - K H)' + K R K'.

The innovation y - yhat is white with the covariance S = H P H' + R if the model is right (Kailath 1968, An innovations
approach to least-squares estimation, IEEE Trans. Automatic Control 13), so the normalised innovation L^-1 (y - yhat)
with L L' = S is standard normal and its components are independent. A row is one compiled function.

Exceptions:

- A missing value is NaN; it corrects nothing. Nor does one beyond the gate, unless the caller accepts it: one outlier
  would disturb the state for minutes.
- An interval of more than `LONGEST_STEP_MIN` takes several steps. After a gap of more than `LONGEST_GAP_MIN`, or a step
  back in time, the filter restarts: near an unstable state the uncertainty grows without bound, and the model does not
  know how the plant was operated meanwhile.
- Where an input changed at an unknown time, the state is predicted for each possible time (see `InputUncertainty`).
- The filter restarts where the equations leave the bounds of the states or are not finite. A correction that leads out
  of the bounds is clipped.
- It starts at the first measurements (see `filter_states`), without an innovation for that row, and waits for them.
- Estimates of constant states (`ProcessModel.constant_states`) survive a restart.
"""

import struct
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from functools import cached_property
from math import ceil, inf, isfinite, nan
from typing import cast

import msgspec
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import ArrayFunction, CompiledFunction
from reactorwatch.kalman.batch import (
    LONGEST_GAP_MIN,
    LONGEST_ROW_MIN,
    BatchedRun,
    FilterRecord,
    FilterResult,
    Innovation,
    RowBatch,
    StepBudget,
    StepCost,
    run_together,
)
from reactorwatch.kalman.ekf_step import NoiseLevels, compiled_row, fill_row, predict_function, row_function, variances
from reactorwatch.kalman.filter_states import InitialState
from reactorwatch.process.model import ProcessModel


class FilterState(msgspec.Struct, frozen=True):
    """State of a filter between two rows.

    Attributes:
        time_min: time of the last row; None before the first.
        inputs: inputs of the last row.
        x: filtered state at the last row.
        P: covariance of the state, row by row.
        learned: whether the estimates of constant states are valid although there is no last row.
    """

    time_min: float | None
    inputs: tuple[float, ...]
    x: tuple[float, ...]
    P: tuple[float, ...]
    learned: bool = False


class Filter:
    """Follows one plant. Not thread-safe.

    Args:
        model: model of the plant.
        noise: noise of the plant and its sensors.
        changes: parameters that differ from the model's values.

    Raises:
        ValueError: noise of another size than the model, or that is not positive (of a state: negative); a change that
            names no parameter, or is out of its bounds.

    Attributes:
        budget: filter steps that it may take; None: unlimited.
        stops_at_restart: if true, a run of a record ends where the filter has diverged and would start again; the
            results of the remaining rows are NaN.
        most_divergences: number of divergences after which a run of a record ends in the same way.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, changes: Mapping[str, float] | None = None) -> None:
        self.model = model
        self._n_x, self._n_y = len(model.states), len(model.outputs)
        self._nothing = Innovation(*((nan,) * self._n_y,) * 4)
        self._row = ArrayFunction(row_function(model))
        self._belief, new, self._constants = (item[0] for item in self._row.arguments)
        after, outputs = (item[0] for item in self._row.results)
        self._belief_view, self._after, self._outputs = (memoryview(item) for item in (self._belief, after, outputs))
        self._new = cast("memoryview[float]", memoryview(new))
        self._unpack = struct.Struct(f"{outputs.size}d").unpack
        self._break_indices = [model.parameter_names.index(name) for name in model.breakpoints]
        self._time_min: float | None = None
        self._lasting, self._learned = list(model.constant_states), False
        self._inputs: tuple[float, ...] = ()
        self._breaks: tuple[float, ...] = ()
        self.noise = noise
        self.budget: StepBudget | None = None
        self.stops_at_restart, self._started = False, False
        self.most_divergences = inf
        self.set_parameters(changes or {})

    def clone(self) -> "Filter":
        """Make another filter of the same model, noise, changes and limits, not yet started; for the same thread."""
        other = Filter(self.model, self._noise, self._changes)
        other._initial_state = self._initial_state  # costs more to make than to use
        other.budget, other.stops_at_restart = self.budget, self.stops_at_restart
        other.most_divergences = self.most_divergences
        return other

    @property
    def noise(self) -> NoiseLevels:
        """Noise of the plant and its sensors."""
        return self._noise

    @noise.setter
    def noise(self, noise: NoiseLevels) -> None:
        n_x, n_y = self._n_x, self._n_y
        if len(noise.measurement_sd) != n_y or not all(0 < sd < inf for sd in noise.measurement_sd):
            raise ValueError(f"measurement_sd must be {n_y} positive numbers, got {noise.measurement_sd}")
        if len(noise.process_sd) != n_x or not all(0 <= sd < inf for sd in noise.process_sd):
            raise ValueError(f"process_sd must be {n_x} numbers of at least 0, got {noise.process_sd}")
        self._noise = noise
        self._constants[len(self.model.parameters) :] = variances(self.model, noise)

    def set_parameters(self, changes: Mapping[str, float]) -> None:
        """Set the parameters that differ from the model's values, from the next row on; reset all others.

        Raises:
            ValueError: a change names no parameter, or is out of its bounds.
        """
        values = self.model.values(changes)
        self._changes = dict(changes)
        self._constants[: values.size] = values
        self._breaks = tuple(sorted({float(values[i]) for i in self._break_indices}))

    def restart(self) -> None:
        """Forget everything and start with the next row."""
        self._time_min, self._learned = None, False

    def interrupt(self) -> None:
        """Start again with the next row; estimates of constant states are kept."""
        self._time_min = None

    @property
    def state(self) -> FilterState:
        """The filter's full state."""
        belief = tuple(self._belief.tolist())
        return FilterState(self._time_min, self._inputs, belief[: self._n_x], belief[self._n_x :], self._learned)

    @state.setter
    def state(self, state: FilterState) -> None:
        self._time_min, self._inputs = state.time_min, state.inputs
        self._learned = state.learned or state.time_min is not None
        self._belief[:] = [*state.x, *state.P]

    @property
    def numbers(self) -> tuple[Array, Array]:
        """State with its covariance, and variances of sensors and process per minute: the filter's own, for kernels."""
        return self._belief, self._constants[len(self.model.parameters) :]

    def accept_row(self, time_min: float, inputs: Sequence[float]) -> None:
        """Note a row that was filtered in `belief`; restart after it if its inputs are unknown."""
        self._time_min, self._inputs = time_min if isfinite(sum(inputs)) else None, tuple(inputs)

    def update(
        self,
        time_min: float,
        inputs: Sequence[float],
        measured: Sequence[float],
        *,
        gate: float = inf,
        accept: Sequence[bool] = (),
        changes: Sequence[tuple[float, Sequence[float]]] = (),
    ) -> Innovation:
        """Filter a row.

        Args:
            time_min: time of the row.
            inputs: inputs that hold from this row on; NaN: unknown, so the filter restarts with the next row.
            measured: one value an output; NaN: missing.
            gate: standard deviations beyond which a measurement does not correct the state.
            accept: outputs whose measurement corrects the state whatever the gate; empty: none.
            changes: possible changes of the inputs since the row before, each as likely: a time, not decreasing, and
                the inputs from then until this row (see `InputUncertainty`); empty: the inputs of the row before held.

        Raises:
            BudgetExceededError: the budget is spent; also raised by `run` and `run_batched`.
        """
        n, before = self._n_y, self._time_min
        self._spend(StepCost.ROW)
        if before is None or not 0.0 < time_min - before <= LONGEST_GAP_MIN:
            return self._start(time_min, inputs, measured)
        step = 0.5 * (time_min - before)
        steps = (step, step)
        if changes:
            self._predict_uncertain(before, time_min, inputs, changes)
            steps = (0.0, 0.0)
        elif 2.0 * step > LONGEST_ROW_MIN or self._breaks:
            steps = self._steps(before, time_min, step)
        if len(inputs) != len(self._inputs) or len(measured) != n:
            raise ValueError(f"expected {len(self._inputs)} inputs and {n} measurements, got {inputs} and {measured}")
        fill_row(self._new, self._inputs, inputs, time_min, *steps, measured, gate)
        if True in accept:
            for i, follow in enumerate(accept, -n):
                self._new[i] = inf if follow else gate
        self._row()
        outputs = self._unpack(self._outputs)
        if not outputs[-1]:
            return self._start(time_min, inputs, measured)
        self._belief_view[:] = self._after
        self.accept_row(time_min, inputs)
        return Innovation(outputs[:n], outputs[n : 2 * n], outputs[2 * n : 3 * n], outputs[3 * n : 4 * n])

    def run(self, record: FilterRecord, start: FilterState | None = None) -> FilterResult:
        """Filter a record; the numbers are those of `update`, several times faster.

        Args:
            record: the rows.
            start: state after the row before the first; None: the filter starts with the first row.
        """
        return run_together([self.run_batched(record, start)])[0]

    def run_batched(self, record: FilterRecord, start: FilterState | None = None) -> BatchedRun:
        """Filter a record as `run` does, yielding batches of rows, so that several filters can run together."""
        if start is None:
            self.restart()
        else:
            self.state = start
        self._started = self._time_min is not None
        self._spend(StepCost.RUN)
        rows, near = record.following(self._time_min, self._inputs, self._breaks)
        count, n, n_x = len(rows), self._n_y, self._n_x
        outputs, beliefs = np.empty((count, 5 * n + 1)), np.empty((count, self._belief.size))
        ends = [*np.flatnonzero(~near).tolist(), count]
        row = divergences = 0
        while row < count:
            done = 0
            if self._time_min is not None and near[row]:
                part = slice(row, ends[bisect_left(ends, row)])
                self._spend(part.stop - row)
                arguments = [self._belief, rows[part], self._constants]
                done = yield RowBatch(self.code, part.stop - row, arguments, [beliefs[part], outputs[part]])
                divergences += not done
            if done:
                self._belief[:] = beliefs[row + done - 1]
                row += done
                self.accept_row(float(record.time_min[row - 1]), record.inputs[row - 1].tolist())
            elif divergences > self.most_divergences or (
                self.stops_at_restart and self._started and self._time_min is None
            ):
                outputs[row:], beliefs[row:] = nan, nan
                break
            else:
                self._run_row(record, row, outputs, beliefs)
                row += 1
        prediction, residual, sd, normalized, conditional_sd = (outputs[:, i * n : (i + 1) * n] for i in range(5))
        x, P = beliefs[:, :n_x], beliefs[:, n_x:].reshape(count, n_x, n_x)
        return FilterResult(prediction, residual, sd, normalized, conditional_sd, x, P)

    def _run_row(self, record: FilterRecord, row: int, outputs: Array, beliefs: Array) -> None:
        """Filter a row by `update` and store its results."""
        time_min, inputs, values = record.time_min[row], record.inputs[row].tolist(), record.measured[row].tolist()
        accept = record.accept[row].tolist()
        changes = [] if record.uncertainty is None else record.uncertainty.changes(row)
        result = self.update(float(time_min), inputs, values, gate=record.gate, accept=accept, changes=changes)
        predicted, started = result is not self._nothing, self._time_min is not None
        outputs[row], beliefs[row] = self._outputs if predicted else nan, self._belief if predicted or started else nan

    def prepare(self) -> None:
        """Compile now instead of at the first use; filters of the same model share most of it."""
        self.code.prepare()
        _ = self._prediction, self._initial_state

    @cached_property
    def code(self) -> CompiledFunction:
        """The compiled row, see `ekf_step`."""
        return compiled_row(self.model)

    @cached_property
    def _prediction(self) -> ArrayFunction:
        return ArrayFunction(predict_function(self.model))

    def _steps(self, before: float, time_min: float, half: float) -> tuple[float, float]:
        """Lengths of the last two steps of an interval; predicts up to their start."""
        within = [point for point in self._breaks if before < point < time_min]
        if 2.0 * half > LONGEST_ROW_MIN or len(within) > 1:
            *edges, middle, end = self._edges(before, time_min)
            self._belief[:] = self._predict(self._belief, self._inputs, edges)
            return middle - edges[-1], end - middle
        return (within[0] - before, time_min - within[0]) if within else (half, half)

    def _edges(self, before: float, time_min: float) -> list[float]:
        """Edges of an even number of steps over an interval."""
        edges = [before]
        for end in (*(point for point in self._breaks if before < point < time_min), time_min):
            count, begin = ceil((end - edges[-1]) / (0.5 * LONGEST_ROW_MIN)), edges[-1]
            edges += [begin + (end - begin) * i / count for i in range(1, count)]
            edges.append(end)
        if len(edges) % 2 == 0:
            edges.append(edges[-1])
        return edges

    def _predict(self, belief: Array, inputs: Sequence[float], edges: Sequence[float]) -> Array:
        """State and covariance after some steps, taken two by two."""
        prediction = self._prediction
        self._spend(StepCost.PREDICTION * (len(edges) // 2))
        prediction.arguments[2][0] = self._constants
        for begin, middle, end in zip(edges[:-2:2], edges[1:-1:2], edges[2::2], strict=True):
            prediction.arguments[0][0] = belief
            prediction.arguments[1][0] = [*inputs, end, middle - begin, end - middle]
            prediction()
            belief = prediction.results[0][0].copy()
        return belief

    def _predict_uncertain(
        self,
        before: float,
        time_min: float,
        inputs: Sequence[float],
        changes: Sequence[tuple[float, Sequence[float]]],
    ) -> None:
        """Predict an interval with one of several changes of the inputs, by the moments of the mixture."""
        held, now, ends = self._belief.copy(), before, []
        for time, other in changes:
            changed = min(max(time, before), time_min)
            if changed > now:
                held, now = self._predict(held, self._inputs, self._edges(now, changed)), changed
            end = held
            if changed < time_min:
                end = self._predict(self._reset(held, other, changed), other, self._edges(changed, time_min))
            ends.append(self._reset(end, inputs, time_min))
        mean = np.mean(ends, axis=0)
        deviation = np.array(ends)[:, : self._n_x] - mean[: self._n_x]
        self._belief[:] = mean
        self._belief[self._n_x :] += (deviation.T @ deviation / len(ends)).ravel()
        self._inputs = tuple(inputs)

    def _reset(self, belief: Array, inputs: Sequence[float], time_min: float) -> Array:
        """Apply the jumps (`ProcessModel.resets`) of a row with these inputs."""
        if not self.model.resets:
            return belief
        n, p = self._n_x, self._constants[: len(self.model.parameters)]
        x, P = self._initial_state.reset(belief[:n], belief[n:].reshape(n, n), np.asarray(inputs), p, time_min)
        return np.concatenate([x, P.ravel()])

    @cached_property
    def _initial_state(self) -> InitialState:
        return InitialState(self.model)

    def _spend(self, steps: int) -> None:
        if self.budget is not None:
            self.budget.spend(steps)

    def _start(self, time_min: float, inputs: Sequence[float], measured: Sequence[float]) -> Innovation:
        """Start at the measurements, if there are any."""
        self._time_min = None
        if self.stops_at_restart and self._started:
            return self._nothing
        searches = self._initial_state.searches
        found = self._initial_state.estimate(time_min, inputs, measured, self._noise.measurement_sd, self._changes)
        self._spend(StepCost.SEARCH * (self._initial_state.searches - searches))
        if found is not None:
            self._spend(StepCost.START)
            x, P = found
            if self._lasting and self._learned:  # estimates of constant states are kept
                kept, n = self._lasting, self._n_x
                P[kept], P[:, kept] = 0.0, 0.0
                x[kept] = self._belief[kept]
                P[np.ix_(kept, kept)] = self._belief[n:].reshape(n, n)[np.ix_(kept, kept)]
            self._learned = True
            self._belief[:] = [*x, *P.ravel()]
            self.accept_row(time_min, inputs)
            self._started = True
        return self._nothing
