"""The extended Kalman filter of a process model: what the next measurement should be, and how sure that is.

Between two rows the state follows the model's equations and its covariance their linearisation: with F the Jacobian of
the way and Q the process noise of a minute (see `NoiseLevels`)

    x <- Phi(x, u),    P <- F P F' + Q h,

with the input of the row before, which was held until now. The measurements of a row, whose noise is independent of
each other's, then correct it one after the other, in the form of Joseph (Bucy & Joseph 1968, Filtering for Stochastic
Processes with Applications to Guidance), which keeps P symmetric and positive definite over months:

    K = P H' / (H P H' + R),    x <- x + K (y - yhat),    P <- (1 - K H) P (1 - K H)' + K R K'.

The innovation y - yhat is white with the covariance S = H P H' + R if the model is right (Kailath 1968, An innovations
approach to least-squares estimation, IEEE Trans. Automatic Control 13), so L^-1 (y - yhat) with L L' = S is standard
normal and its components are independent of each other. All that is done for a row is one compiled function.

What is out of the ordinary is handled like this:

- A value that is missing is NaN; it corrects nothing. One that is far off corrects nothing until the caller says that
  it is to be followed: one outlier would pull the filter away for minutes.
- A row more than `LONGEST_STEP_MIN` after the one before is walked to in steps. After a gap of more than
  `LONGEST_GAP_MIN`, or a step back in time, the filter begins anew: on an unstable stretch the uncertainty grows
  without bound, and the model does not know what was done to the plant meanwhile.
- Where an input is another behind missing rows, nobody knows when it changed; the state is predicted for each moment
  that it may have, and is as uncertain as that makes it (see `doubt`).
- It begins anew as well where the equations leave the bounds of the states, or are no numbers any more. A correction
  that leads out of the bounds is cut off there.
- It begins at what is measured (see `initial_state`), and says nothing of that row; as long as nothing is, it waits.
- What it has learned of a state that never changes (`ProcessModel.lasting`) outlasts a beginning.
"""

import struct
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from functools import cached_property
from math import ceil, inf, isfinite, nan

import msgspec
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.array_function import ArrayFunction
from reactorwatch.codegen.compiled_function import RowCode
from reactorwatch.kalman.batch_runner import Stretch, Stretches, alone
from reactorwatch.kalman.ekf_step import row_code, row_function, walk_function
from reactorwatch.kalman.filter_record import LONGEST_ROW_MIN, FilterRecord
from reactorwatch.kalman.initial_state import Beginning
from reactorwatch.kalman.innovations import Innovation, Innovations
from reactorwatch.kalman.input_uncertainty import Doubt
from reactorwatch.kalman.step_budget import A_BEGINNING, A_ROW_ALONE, A_RUN, A_SEARCH, A_WALK, StepBudget
from reactorwatch.process.model import ProcessModel

LONGEST_GAP_MIN = 30.0

LEAST_PROCESS_SD = 1e-6
"""Of the scale of a state. Without any process noise its covariance would shrink below what a number can hold."""


class NoiseLevels(msgspec.Struct, frozen=True):
    """The noise of a process and of its sensors.

    Attributes:
        measurement_sd: one an output, in its unit.
        process_sd: one a state, in its unit per square root of a minute: dx = f(x) dt + sd dW.
    """

    measurement_sd: tuple[float, ...]
    process_sd: tuple[float, ...]


class FilterState(msgspec.Struct, frozen=True):
    """Everything that a filter remembers.

    Attributes:
        time_min: of the last row; None before the first.
        inputs: of the last row.
        x: the state there.
        P: its covariance, row by row.
        learned: whether, where there is no last row, something is known all the same of the states that never change.
    """

    time_min: float | None
    inputs: tuple[float, ...]
    x: tuple[float, ...]
    P: tuple[float, ...]
    learned: bool = False


def variances(model: ProcessModel, noise: NoiseLevels) -> Array:
    """Of the sensors and of the process in a minute, as the compiled rows take them, see `ekf_step`."""
    least = [LEAST_PROCESS_SD * state.scale for state in model.states]
    return np.asarray(np.square(np.concatenate([noise.measurement_sd, np.maximum(noise.process_sd, least)])))


class Filter:
    """Follows one plant. Not for two threads at once.

    Args:
        model: of the plant.
        noise: of the plant and its sensors.
        changes: parameters that differ from the model's values.

    Raises:
        ValueError: noise of another size than the model, or that is not positive (of a state: negative); a change that
            names no parameter, or is out of its bounds.

    Attributes:
        budget: of the filter steps that its rows are counted by; None: they are not.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, changes: Mapping[str, float] | None = None) -> None:
        self.model = model
        self._n_x, self._n_y = len(model.states), len(model.outputs)
        self._nothing = Innovation(*((nan,) * self._n_y,) * 4)
        self._row = ArrayFunction(row_function(model))
        self._memory, new, self._constants = (item[0] for item in self._row.arguments)
        after, told = (item[0] for item in self._row.results)
        self._memory_view, self._new, self._after, self._told = (
            memoryview(item) for item in (self._memory, new, after, told)
        )
        self._pack, self._unpack = struct.Struct(f"{new.size}d").pack_into, struct.Struct(f"{told.size}d").unpack
        self._break_places = [model.parameter_names.index(name) for name in model.breakpoints]
        self._time_min: float | None = None
        self._lasting, self._learned = list(model.lasting), False
        self._inputs: tuple[float, ...] = ()
        self._breaks: tuple[float, ...] = ()
        self.noise = noise
        self.budget: StepBudget | None = None
        self.change(changes or {})

    def twin(self) -> "Filter":
        """Another one of the same model, noise and changes, which knows nothing yet; for the same thread."""
        other = Filter(self.model, self._noise, self._changes)
        other._beginning = self._beginning  # what it takes to make is more than to use it
        return other

    @property
    def noise(self) -> NoiseLevels:
        """Of the plant and its sensors."""
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

    def change(self, changes: Mapping[str, float]) -> None:
        """From the next row on, these parameters differ from the model's values, and no others do.

        Raises:
            ValueError: one names no parameter, or is out of its bounds.
        """
        values = self.model.values(changes)
        self._changes = dict(changes)
        self._constants[: values.size] = values
        self._breaks = tuple(sorted({float(values[place]) for place in self._break_places}))

    def restart(self) -> None:
        """Begin anew with the next row, knowing nothing."""
        self._time_min, self._learned = None, False

    @property
    def state(self) -> FilterState:
        """Everything that it remembers."""
        memory = tuple(self._memory.tolist())
        return FilterState(self._time_min, self._inputs, memory[: self._n_x], memory[self._n_x :], self._learned)

    @state.setter
    def state(self, state: FilterState) -> None:
        self._time_min, self._inputs = state.time_min, state.inputs
        self._learned = state.learned or state.time_min is not None
        self._memory[:] = [*state.x, *state.P]

    def update(
        self,
        time_min: float,
        inputs: Sequence[float],
        measured: Sequence[float],
        *,
        gate: float = inf,
        accept: Sequence[bool] = (),
        doubt: tuple[Sequence[float], Sequence[float]] | None = None,
        between: tuple[float, Sequence[Sequence[float]]] | None = None,
    ) -> Innovation:
        """Take a row in.

        Args:
            time_min: of the row.
            inputs: that hold from this row on; NaN: nobody knows them, so the filter begins anew with the next row.
            measured: one an output; NaN: missing.
            gate: standard deviations beyond which a measurement does not correct the state ...
            accept: ... unless this says so for its output; empty: for none.
            doubt: the inputs that may have held before the row already, and the times from which on, in order, each as
                likely (see `doubt`); None: it is known that those of the row before did.
            between: a time since the row before from which on the inputs are not known, and inputs that may have held
                from then until this row, each as likely; None: they are known. Not together with `doubt`.

        Raises:
            StepsSpentError: the budget does not reach for the row; also raised by `run`, `over` and `stretches`.
        """
        n, before = self._n_y, self._time_min
        if self.budget is not None:
            self.budget.spend(A_ROW_ALONE)
        if before is None or not 0.0 < time_min - before <= LONGEST_GAP_MIN:
            return self._begin(time_min, inputs, measured)
        step = 0.5 * (time_min - before)
        steps = (step, step)
        if doubt is not None:
            self._predict_in_doubt(before, time_min, inputs, *doubt)
            steps = (0.0, 0.0)
        elif between is not None:
            self._predict_between(before, time_min, inputs, *between)
            steps = (0.0, 0.0)
        elif 2.0 * step > LONGEST_ROW_MIN or self._breaks:
            steps = self._steps(before, time_min, step)
        limits = [inf if follow else gate for follow in accept] if True in accept else [gate] * n
        self._pack(self._new, 0, *self._inputs, *inputs, time_min, *steps, *measured, *limits)
        self._row()
        told = self._unpack(self._told)
        if not told[-1]:
            return self._begin(time_min, inputs, measured)
        self._memory_view[:] = self._after
        self._remember(time_min, inputs)
        return Innovation(told[:n], told[n : 2 * n], told[2 * n : 3 * n], told[3 * n : 4 * n])

    def _remember(self, time_min: float, inputs: Sequence[float]) -> None:
        """The row, if it is known what the inputs do from it on."""
        self._time_min, self._inputs = time_min if isfinite(sum(inputs)) else None, tuple(inputs)

    def run(
        self,
        time_min: Array,
        inputs: Array,
        measured: Array,
        *,
        gate: float = inf,
        accept: NDArray[np.bool_] | None = None,
        start: FilterState | None = None,
        doubt: Doubt | None = None,
    ) -> Innovations:
        """Take a whole record in; the numbers are those of `update`, several times faster.

        Args:
            time_min: shape (rows,).
            inputs: shape (rows, n_u) or (rows,) for one input.
            measured: shape (rows, n_y); NaN where missing.
            gate: as for `update`.
            accept: likewise, shape (rows, n_y).
            start: what the filter remembers of the row before the first; None: it begins with the first row.
            doubt: ways on which nobody knows when inputs changed; None: there are none.
        """
        return self.over(FilterRecord.of(time_min, inputs, measured, gate, accept, doubt), start)

    def over(self, record: FilterRecord, start: FilterState | None = None) -> Innovations:
        """As `run`, of a record that is laid out already."""
        return alone(self.stretches(record, start))

    def stretches(self, record: FilterRecord, start: FilterState | None = None) -> Stretches:
        """As `over`, with a stop at every stretch of rows, for whoever takes those of several filters at once."""
        if start is None:
            self.restart()
        else:
            self.state = start
        self._spend(A_RUN)
        rows, near = record.following(self._time_min, self._inputs, self._breaks)
        count, n, n_x = len(rows), self._n_y, self._n_x
        told, memory = np.empty((count, 5 * n + 1)), np.empty((count, self._memory.size))
        ends = [*np.flatnonzero(~near).tolist(), count]
        row = 0
        while row < count:
            done = 0
            if self._time_min is not None and near[row]:
                part = slice(row, ends[bisect_left(ends, row)])
                self._spend(part.stop - row)
                done = yield Stretch(self.code, self._memory, rows[part], self._constants, memory[part], told[part])
            if done:
                self._memory[:] = memory[row + done - 1]
                row += done
                self._remember(float(record.time_min[row - 1]), record.inputs[row - 1].tolist())
            else:
                self._run_row(record, row, told, memory)
                row += 1
        prediction, residual, sd, whitened, conditional_sd = (
            told[:, place * n : (place + 1) * n] for place in range(5)
        )
        x, P = memory[:, :n_x], memory[:, n_x:].reshape(count, n_x, n_x)
        return Innovations(prediction, residual, sd, whitened, conditional_sd, x, P)

    def _run_row(self, record: FilterRecord, row: int, told: Array, memory: Array) -> None:
        """Take a row in by itself."""
        time_min, inputs, values = record.time_min[row], record.inputs[row].tolist(), record.measured[row].tolist()
        doubt, accept = record.doubt, record.accept[row].tolist()
        other = (doubt.inputs[row].tolist(), doubt.times_min(row)) if doubt is not None and doubt.rows[row] else None
        found = self.update(float(time_min), inputs, values, gate=record.gate, accept=accept, doubt=other)
        said, known = found is not self._nothing, self._time_min is not None
        told[row], memory[row] = self._told if said else nan, self._memory if said or known else nan

    def prepare(self) -> None:
        """Make now what is otherwise made at its first use; filters of the same model share most of it."""
        self.code.prepare()
        _ = self._walk, self._beginning

    @cached_property
    def code(self) -> RowCode:
        """Of its rows, see `ekf_step`."""
        return row_code(self.model)

    @cached_property
    def _walk(self) -> ArrayFunction:
        return ArrayFunction(walk_function(self.model))

    def _within(self, before: float, time_min: float) -> list[float]:
        """The breakpoints between two rows."""
        return [point for point in self._breaks if before < point < time_min]

    def _steps(self, before: float, time_min: float, half: float) -> tuple[float, float]:
        """The lengths of the last two steps of a way; up to there it is walked."""
        within = self._within(before, time_min)
        if 2.0 * half > LONGEST_ROW_MIN or len(within) > 1:
            return self._walk_to_last_steps(before, time_min)
        return (within[0] - before, time_min - within[0]) if within else (half, half)

    def _walk_to_last_steps(self, before: float, time_min: float) -> tuple[float, float]:
        """Predict up to the last two steps of the way; returns their lengths."""
        *edges, middle, end = self._edges(before, time_min)
        self._memory[:] = self._walked(self._memory, self._inputs, edges)
        return middle - edges[-1], end - middle

    def _edges(self, before: float, time_min: float) -> list[float]:
        """Where the steps of a way begin and end, an even number of steps."""
        edges = [before]
        for end in (*self._within(before, time_min), time_min):
            count, begin = ceil((end - edges[-1]) / (0.5 * LONGEST_ROW_MIN)), edges[-1]
            edges += [begin + (end - begin) * number / count for number in range(1, count)]
            edges.append(end)
        if len(edges) % 2 == 0:
            edges.append(edges[-1])
        return edges

    def _walked(self, memory: Array, inputs: Sequence[float], edges: Sequence[float]) -> Array:
        """State and covariance after some steps, two by two."""
        walk = self._walk
        self._spend(A_WALK * (len(edges) // 2))
        walk.arguments[2][0] = self._constants
        for begin, middle, end in zip(edges[:-2:2], edges[1:-1:2], edges[2::2], strict=True):
            walk.arguments[0][0] = memory
            walk.arguments[1][0] = [*inputs, end, middle - begin, end - middle]
            walk()
            memory = walk.results[0][0].copy()
        return memory

    def _predict_in_doubt(
        self, before: float, time_min: float, inputs: Sequence[float], other: Sequence[float], times: Sequence[float]
    ) -> None:
        """Predict a whole way on which the inputs became others, nobody knows when."""
        held, now, ends = self._memory.copy(), before, []
        for moment in times:
            changed = min(max(moment, before), time_min)
            if changed > now:
                held, now = self._walked(held, self._inputs, self._edges(now, changed)), changed
            end = held
            if changed < time_min:
                end = self._walked(self._reset(held, other, changed), other, self._edges(changed, time_min))
            ends.append(self._reset(end, inputs, time_min))
        self._mix(ends, inputs)

    def _predict_between(
        self,
        before: float,
        time_min: float,
        inputs: Sequence[float],
        since: float,
        others: Sequence[Sequence[float]],
    ) -> None:
        """Predict a whole way on which the inputs were one of several from some time on."""
        held = self._memory.copy()
        if since > before:
            held = self._walked(held, self._inputs, self._edges(before, since))
        edges = self._edges(since, time_min)
        ends = [self._walked(self._reset(held, other, since), other, edges) for other in others]
        self._mix([self._reset(end, inputs, time_min) for end in ends], inputs)

    def _mix(self, ends: Sequence[Array], inputs: Sequence[float]) -> None:
        """The state as the mean of where some ways lead, each as likely, and as uncertain as they are apart."""
        mean = np.mean(ends, axis=0)
        apart = np.array(ends)[:, : self._n_x] - mean[: self._n_x]
        self._memory[:] = mean
        self._memory[self._n_x :] += (apart.T @ apart / len(ends)).ravel()
        self._inputs = tuple(inputs)

    def _reset(self, memory: Array, inputs: Sequence[float], time_min: float) -> Array:
        """When a row has begun, with its inputs."""
        if not self.model.resets:
            return memory
        n, p = self._n_x, self._constants[: len(self.model.parameters)]
        x, P = self._beginning.reset(memory[:n], memory[n:].reshape(n, n), np.asarray(inputs), p, time_min)
        return np.concatenate([x, P.ravel()])

    @cached_property
    def _beginning(self) -> Beginning:
        return Beginning(self.model)

    def _spend(self, steps: int) -> None:
        if self.budget is not None:
            self.budget.spend(steps)

    def _begin(self, time_min: float, inputs: Sequence[float], measured: Sequence[float]) -> Innovation:
        """Begin at what is measured, if anything is."""
        self._time_min = None
        searches = self._beginning.searches
        found = self._beginning.at(time_min, inputs, measured, self._noise.measurement_sd, self._changes)
        self._spend(A_SEARCH * (self._beginning.searches - searches))
        if found is not None:
            self._spend(A_BEGINNING)
            x, P = found
            if self._lasting and self._learned:
                self._keep_lasting(x, P)
            self._learned = True
            self._memory[:] = [*x, *P.ravel()]
            self._remember(time_min, inputs)
        return self._nothing

    def _keep_lasting(self, x: Array, P: Array) -> None:
        """Put what is known of the states that never change into a beginning."""
        known, n_x = self._lasting, self._n_x
        P[known], P[:, known] = 0.0, 0.0
        x[known] = self._memory[known]
        P[np.ix_(known, known)] = self._memory[n_x:].reshape(n_x, n_x)[np.ix_(known, known)]
