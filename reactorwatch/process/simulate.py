"""Simulation of a model over an input record.

The method is the pair of Cash & Karp (1990), A variable order Runge-Kutta method for initial value problems with
rapidly varying right-hand sides, ACM Trans. Math. Softw. 16(3), orders 5 and 4: six evaluations a step, error estimate
included. On the operating branch a fixed step of 0.05 min is inside the tolerance, and a record of thousands of rows
runs as one piece of machine code. (The pair of Dormand & Prince takes seven evaluations, the last of which would only
save one if the input did not jump, and at this step has twice the error.) Where the estimate exceeds the tolerance (an
upset, an ignition: the reaction then has time constants below a second) the interval is integrated with adaptive steps.

A step never crosses a sample, where the input jumps, nor a breakpoint of the model. States that jump when a row begins
(`ProcessModel.resets`) do so at the end of the step before, so a trajectory has the state after the jump.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from math import inf, isfinite

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import ArrayFunction, CompiledFunction
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel

LONGEST_STEP_MIN = 0.05  # inside the tolerance on the reactor's operating branch, see above
TOLERANCE = 1e-6
"""Allowed local error of a step, relative to `Variable.scale` of each state."""

_TIMES = (0.0, 1 / 5, 3 / 10, 3 / 5, 1.0, 7 / 8)
_STAGES: tuple[tuple[float, ...], ...] = (
    (),
    (1 / 5,),
    (3 / 40, 9 / 40),
    (3 / 10, -9 / 10, 6 / 5),
    (-11 / 54, 5 / 2, -70 / 27, 35 / 27),
    (1631 / 55296, 175 / 512, 575 / 13824, 44275 / 110592, 253 / 4096),
)
_FIFTH_ORDER = (37 / 378, 0.0, 250 / 621, 125 / 594, 0.0, 512 / 1771)
_FOURTH_ORDER = (2825 / 27648, 0.0, 18575 / 48384, 13525 / 55296, 277 / 14336, 1 / 4)
_ERROR = tuple(fifth - fourth for fifth, fourth in zip(_FIFTH_ORDER, _FOURTH_ORDER, strict=True))


class SimulationError(ValueError):
    """The equations cannot be integrated further; the text says where."""


def rest_function(model: ProcessModel) -> ca.Function:
    """(states that are not in `at_rest`, u, p, t) -> x, with all others in equilibrium."""
    _, u, p, t, x = model.at_one_time(ca.vertcat(*model.rest_expressions()))
    core = ca.vertcat(*(state.symbol for state in model.states if state.name not in model.at_rest))
    return ca.Function("rest", [core, u, p, t], [ca.densify(x)])


def reset_function(model: ProcessModel) -> ca.Function:
    """(x, u, p, t) -> x after the jumps at a row at t, from which on u holds."""
    after = ca.vertcat(*(model.resets.get(state.name, state.symbol) for state in model.states))
    *symbols, result = model.at_one_time(after)
    return ca.Function("reset", symbols, [ca.densify(result)])


def with_derivatives(function: ca.Function, *arguments: int) -> ca.Function:
    """Append the derivatives of the only result with respect to some arguments, given by index."""
    symbols = function.sx_in()
    result = function(*symbols)
    derivatives = (ca.densify(ca.jacobian(result, symbols[i])) for i in arguments)
    return ca.Function(function.name(), symbols, [result, *derivatives])


def state_time_step(model: ProcessModel, u: ca.SX, p: ca.SX, t: ca.SX, middle: ca.SX, h: ca.SX) -> ca.SX:
    """Time step of the states in a step of the clock from t to t + h; see `ProcessModel.time_offset`."""
    clock = model.clock
    if not ca.depends_on(model.time_offset, ca.vertcat(clock.now, clock.middle)):
        return h
    _, inputs, parameters = model.arguments()
    ahead = ca.Function("ahead", [inputs, parameters, clock.now, clock.middle], [model.time_offset])
    return h - (ahead(u, p, t + h, middle) - ahead(u, p, t, middle))


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def symbolic_step(model: ProcessModel) -> ca.Function:
    """One step as a CasADi function (x, u, p, t, t_middle, h) -> (x at t + h, error estimate over scale).

    The error estimate is the largest over the states, a scalar.
    """
    rhs = model.function("rhs")
    x, u, p = model.arguments()
    t, middle, h = ca.SX.sym("t"), ca.SX.sym("t_middle"), ca.SX.sym("h")
    passed, slopes = state_time_step(model, u, p, t, middle, h), list[ca.SX]()
    for time, weights in zip(_TIMES, _STAGES, strict=True):
        slopes.append(rhs(x + passed * _weighted_sum(weights, slopes), u, p, t + time * h, middle)[0])
    after = x + passed * _weighted_sum(_FIFTH_ORDER, slopes)
    error = passed * _weighted_sum(_ERROR, slopes)
    # States that effects add are linear and stable, so their errors do not grow; after a jump of an input they respond
    # as fast as a step is long.
    scales = ca.DM([state.scale * (100 if state.name in model.at_rest else 1) for state in model.states])
    return ca.Function(
        "step",
        [x, u, p, t, middle, h],
        [after, ca.mmax(ca.fabs(error / scales))],
        ["x", "u", "p", "t", "t_middle", "h"],
        ["x_next", "error"],
    )


def _weighted_sum(weights: tuple[float, ...], slopes: list[ca.SX]) -> ca.SX:
    terms = (weight * slope for weight, slope in zip(weights, slopes, strict=True) if weight)
    return sum(terms, ca.SX(0))


@dataclass(frozen=True, eq=False)
class StepGrid:
    """Consecutive integration steps of a run, which end at every sample and every breakpoint.

    Attributes:
        start_min: start of each step, shape (steps,).
        length_min: length of each step, shape (steps,).
        middle_min: middle of the interval without a jump that contains the step, shape (steps,).
        row: row of the record whose input holds, shape (steps,).
        end_of_row: index of the step that ends at the following row, shape (rows - 1,).
    """

    start_min: Array
    length_min: Array
    middle_min: Array
    row: NDArray[np.int64]
    end_of_row: NDArray[np.int64]


def step_grid(time_min: Array, breakpoints: Array) -> StepGrid:
    """Make steps that end at every sample and every breakpoint.

    A breakpoint on a sample opens an interval of zero length before it.

    Args:
        time_min: shape (rows,), increasing.
        breakpoints: shape (n,), times in minutes; those outside the record have no effect.
    """
    inside = np.flatnonzero((breakpoints >= time_min[0]) & (breakpoints < time_min[-1]))
    edges = np.sort(np.concatenate([time_min, breakpoints[inside]]), kind="stable")
    interval = np.diff(edges)
    middle = np.minimum(0.5 * (edges[:-1] + edges[1:]), np.nextafter(edges[1:], -np.inf))  # before the jump at its end
    counts = np.maximum(np.ceil(interval / LONGEST_STEP_MIN - 1e-9).astype(np.int64), 1)
    part = np.repeat(np.arange(interval.size), counts)
    position = np.arange(part.size) - np.repeat(np.cumsum(counts) - counts, counts)
    share = 1.0 / counts[part]
    row = np.searchsorted(time_min, edges[:-1], side="right") - 1
    ends = np.cumsum(counts) - 1
    return StepGrid(
        start_min=edges[part] + position * share * interval[part],
        length_min=share * interval[part],
        middle_min=middle[part],
        row=row[part],
        end_of_row=ends[np.searchsorted(edges[1:], time_min[1:], side="left")],
    )


class Stepper:
    """Integrates a model with adaptive steps.

    Args:
        model: the process.
    """

    def __init__(self, model: ProcessModel) -> None:
        self._model = model
        self._step = ArrayFunction(symbolic_step(model))
        self._breakpoints = [model.parameter_names.index(name) for name in model.breakpoints]
        self._reset = ArrayFunction(reset_function(model)) if model.resets else None

    def start_row(self, x: Array, u: Array, p: Array, time_min: float) -> Array:
        """State after the jumps (`ProcessModel.resets`) at a row, from which on u is the input."""
        if self._reset is None:
            return x
        after: Array = self._reset.call(x, u, p, time_min)[0][0]
        return after

    def advance(self, x: Array, u: Array, p: Array, start_min: float, end_min: float) -> Array:
        """State at the end of an interval of plant time over which the input is constant.

        Raises:
            SimulationError: the equations cannot be integrated further.
        """
        jumps = sorted({float(p[i]) for i in self._breakpoints if start_min < p[i] < end_min})
        edges = [start_min, *jumps, end_min]
        for left, right in pairwise(edges):
            x, _ = self.integrate(x, u, p, left, right - left, 0.5 * (left + right))
        return x

    def integrate(
        self, x: Array, u: Array, p: Array, start_min: float, length_min: float, middle_min: float
    ) -> tuple[Array, int]:
        """Integrate over an interval without a jump; returns the state at its end and the number of steps.

        Raises:
            SimulationError: no step, however short, keeps the tolerance, or too many are needed.
        """
        state, inputs, parameters, time, middle, length = (argument[0] for argument in self._step.arguments)
        after, estimate = (result[0] for result in self._step.results)
        state[:], inputs[:], parameters[:], middle[0] = x, u, p, middle_min
        done, step, count = 0.0, min(length_min, LONGEST_STEP_MIN), 0
        while done < length_min:
            step = min(step, length_min - done)
            if length_min - done - step < 1e-12 * length_min:
                step = length_min - done
            time[0], length[0] = start_min + done, step
            self._step()
            error = estimate.item() / TOLERANCE
            good = isfinite(error) and bool(np.isfinite(after).all())
            if good and error <= 1.0:
                done += step
                count += 1
                state[:] = after
                step = min(LONGEST_STEP_MIN, step * min(5.0, 0.9 * max(error, 1e-10) ** -0.2))
                stuck = count > 100_000  # some half a second: the equations are too stiff
            else:
                step *= max(0.1, 0.9 * error**-0.2) if good else 0.1
                stuck = step < 1e-9  # 60 ns: no plant is as fast
            if stuck:
                where = zip(self._model.states, state.tolist(), strict=True)
                values = ", ".join(f"{item.name} = {value:g} {item.unit}" for item, value in where)
                raise SimulationError(
                    f"{self._model.name} cannot be integrated beyond {start_min + done:g} min, where {values}"
                )
        return state.copy(), count


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A simulation.

    Attributes:
        time_min: shape (rows,).
        states: shape (rows, n_x).
        outputs: shape (rows, n_y), without noise.
    """

    time_min: Array
    states: Array
    outputs: Array


class Simulator:
    """Simulates one model; keeps its compiled code. Not thread-safe.

    Args:
        model: the process.
    """

    def __init__(self, model: ProcessModel) -> None:
        self.model = model
        self._n_core = sum(state.name not in model.at_rest for state in model.states)
        self._breakpoints = [model.parameter_names.index(name) for name in model.breakpoints]
        self._complete = rest_function(model)
        self._stepper = Stepper(model)

    def run(
        self,
        time_min: Array,
        inputs: Array,
        start: Array,
        changes: Mapping[str, float] | None = None,
    ) -> Trajectory:
        """Simulate from an initial state.

        Args:
            time_min: shape (rows,), increasing.
            inputs: shape (rows, n_u) or (rows,) for one input; row k holds over [t_k, t_k+1).
            start: initial state, shape (n_x,); or without the states of `ProcessModel.at_rest`, which must be the last
                ones and are then in equilibrium.
            changes: parameters that differ from the model's values.

        Raises:
            ValueError: shapes that do not fit, times that do not increase, NaN, an input or parameter out of bounds.
            SimulationError: the equations cannot be integrated further.
        """
        inputs, start, p = self._check(time_min, inputs, start, changes)
        if start.size < len(self.model.states):
            start = np.array(self._complete(start, inputs[0], p, float(time_min[0]))).ravel()
        start = self._stepper.start_row(start, inputs[0], p, float(time_min[0]))
        grid = step_grid(time_min, p[self._breakpoints])
        states = np.vstack([start, self._run_steps(grid, inputs, start, p)[grid.end_of_row]])
        (y,) = compiled_outputs(self.model).map(states, inputs, p, time_min)
        return Trajectory(time_min, states, y[:, :, 0])

    def _run_steps(self, grid: StepGrid, inputs: Array, start: Array, p: Array) -> Array:
        """State after each step.

        The compiled steps run until one breaks the tolerance; from there on the stepper integrates until one step needs
        no cutting, and they resume after it.
        """
        steps = grid.length_min.size
        states, good = np.empty((steps, start.size)), np.empty(steps)
        columns = self._columns(grid, inputs)
        code = _compiled_steps(self.model)
        x, first, ends = start, 0, set(grid.end_of_row.tolist())
        while first < steps:
            u, *times = (column[first:] for column in columns)
            done = code.fill(steps - first, [x, u, p, *times], [states[first:], good[first:]])
            first += done
            x = states[first - 1] if first else start
            cutting = True
            while cutting and first < steps:
                t, h, middle = grid.start_min[first], grid.length_min[first], grid.middle_min[first]
                x, parts = self._stepper.integrate(x, inputs[grid.row[first]], p, float(t), float(h), float(middle))
                cutting = parts > 1
                if self.model.resets and first in ends:
                    row = grid.row[first] + 1
                    x = self._stepper.start_row(x, inputs[row], p, float(t + h))
                states[first] = x
                first += 1
        return states

    def _columns(self, grid: StepGrid, inputs: Array) -> tuple[Array, Array, Array, Array]:
        """Arguments of every step: u as in `_row_step`, its start, the middle of its interval and its length."""
        u = inputs[grid.row]
        if self.model.resets:
            last = np.isin(np.arange(grid.row.size), grid.end_of_row)
            u = np.column_stack([u, inputs[grid.row + last], last])
        return np.ascontiguousarray(u, dtype=np.float64), grid.start_min, grid.middle_min, grid.length_min

    def _check(
        self, time_min: Array, inputs: Array, start: Array, changes: Mapping[str, float] | None
    ) -> tuple[Array, Array, Array]:
        inputs = np.asarray(inputs, dtype=float)
        inputs = inputs[:, None] if inputs.ndim == 1 else inputs
        start = np.asarray(start, dtype=float)
        model = self.model
        if time_min.size < 2:
            raise ValueError(f"a run must have at least 2 rows, got {time_min.size}")
        if not np.all(np.diff(time_min) > 0):
            row = int(np.argmax(np.diff(time_min) <= 0)) + 1
            raise ValueError(f"times must increase, got {time_min[row]:g} after {time_min[row - 1]:g} min (row {row})")
        if inputs.shape != (time_min.size, len(model.inputs)):
            raise ValueError(f"inputs must have shape {(time_min.size, len(model.inputs))}, got {inputs.shape}")
        if start.shape not in ((len(model.states),), (self._n_core,)) or not np.all(np.isfinite(start)):
            raise ValueError(f"start must be {len(model.states)} finite numbers ({model.state_names}), got {start}")
        for column, item in enumerate(model.inputs):
            outside = ~((inputs[:, column] >= item.lower) & (inputs[:, column] <= item.upper))
            if outside.any():
                row = int(np.argmax(outside))
                raise ValueError(
                    f"{item.name} must be in [{item.lower:g}, {item.upper:g}] {item.unit}, "
                    f"got {inputs[row, column]:g} at {time_min[row]:g} min"
                )
        return inputs, start, model.values(changes)


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def _compiled_steps(model: ProcessModel) -> CompiledFunction:
    """(x, u, p, t, t_middle, h) -> (state after the step, 1 if it keeps the tolerance), step after step."""
    step = _row_step(model)
    after, error = step(*step.sx_in())
    good = ca.logic_and(error <= TOLERANCE, ca.fabs(ca.sum1(after)) < inf)
    return CompiledFunction(ca.Function("step", step.sx_in(), [after, good]), shared=[2], chained=1, stops=True)


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def compiled_outputs(model: ProcessModel) -> CompiledFunction:
    """(x, u, p, t) -> y."""
    x, u, p, t, y = model.output_expressions()
    return CompiledFunction(ca.Function("outputs", [x, u, p, t], [y]), shared=[2])


def _row_step(model: ProcessModel) -> ca.Function:
    """One step; if the model has resets, u is the input, the next row's input, and 1 if the step ends a row."""
    step = symbolic_step(model)
    if not model.resets:
        return step
    x, u, p, t, middle, h = step.sx_in()
    following, last = ca.SX.sym("u_next", u.numel()), ca.SX.sym("last")
    after, error = step(x, u, p, t, middle, h)
    after = ca.if_else(last, reset_function(model)(after, following, p, t + h), after)
    return ca.Function("row_step", [x, ca.vertcat(u, following, last), p, t, middle, h], [after, error])
