"""Simulation of a model over an input record, with exact sensitivities.

Sensitivities are propagated with the state: with x' = Phi(x, p, h) over one step, S' = Phi_x S + Phi_p, where the
derivatives of the discrete step itself are symbolic. So they are the derivatives of exactly the numbers that `run`
returns, not of an approximation of the continuous system.

An onset is a parameter like any other: it moves the edge between two steps, so it enters through their lengths. Before
it, dh/d(onset) = +1 for the interval that ends there; after it, -1, and that interval starts later.

States that jump when a row begins (`ProcessModel.resets`) do so at the end of the step before, so a trajectory has the
state after the jump.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import inf

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.array_function import ArrayFunction
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.process.effect_states import reset_function, rest_function, with_derivatives
from reactorwatch.process.integrate import TOLERANCE, StepGrid, Stepper, step_grid, symbolic_step
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel


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


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """Derivatives of a trajectory with respect to parameters.

    Attributes:
        names: names of the parameters.
        states: shape (rows, n_x, n_p).
        outputs: shape (rows, n_y, n_p).
    """

    names: tuple[str, ...]
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
        self._stepper = Stepper(model)
        self._sensitivity_codes: dict[tuple[int, ...], CompiledFunction] = {}

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
        start, _, _ = self._complete_start(start, inputs, p, time_min)
        grid = self._grid(time_min, p)
        states, _ = self._run_steps(grid, inputs, start, p)
        return self._trajectory(time_min, inputs, p, np.vstack([start, states[grid.end_of_row]]))

    def run_with_sensitivities(
        self,
        time_min: Array,
        inputs: Array,
        start: Array,
        names: Sequence[str],
        changes: Mapping[str, float] | None = None,
        start_sensitivity: Array | None = None,
    ) -> tuple[Trajectory, Sensitivities]:
        """Simulate, with derivatives with respect to some parameters.

        Args:
            time_min: shape (rows,).
            inputs: shape (rows, n_u) or (rows,).
            start: initial state, see `run`.
            names: the parameters to differentiate with respect to.
            changes: parameters that differ from the model's values.
            start_sensitivity: d start / d parameters, shape (start.size, len(names)); zero if not given.

        Raises:
            ValueError: as `run`, or an unknown parameter.
            SimulationError: as `run`.
        """
        inputs, start, p = self._check(time_min, inputs, start, changes)
        wanted = [self.model.parameter_names.index(self.model.parameter(name).name) for name in names]
        shape = (start.size, len(wanted))
        initial = np.zeros(shape) if start_sensitivity is None else np.array(start_sensitivity, dtype=float)
        if initial.shape != shape:
            raise ValueError(f"start_sensitivity must have shape {shape}, got {initial.shape}")
        start, by_start, by_p = self._complete_start(start, inputs, p, time_min)
        initial = by_start @ initial + by_p[:, wanted]
        grid = self._grid(time_min, p)
        states, cuts = self._run_steps(grid, inputs, start, p)
        trajectory = self._trajectory(time_min, inputs, p, np.vstack([start, states[grid.end_of_row]]))
        grid = grid.refine(cuts)
        of_states = self._run_sensitivities(grid, inputs, start, p, wanted, initial)
        of_states = np.concatenate([initial[None], of_states[grid.end_of_row]])
        by_x, by_p = self._output_derivatives.map(trajectory.states, inputs, p, time_min)
        of_outputs: Array = by_x @ of_states + by_p[:, :, wanted]
        return trajectory, Sensitivities(tuple(names), of_states, of_outputs)

    # --- compiled once a model -----------------------------------------------------------------------

    def _sensitivity_code(self, wanted: tuple[int, ...]) -> CompiledFunction:
        """(x, S, u, p, t, t_middle, h, dt, dh) -> (x, S) after the step, for the parameters of these indices."""
        if wanted not in self._sensitivity_codes:
            self._sensitivity_codes[wanted] = self._new_sensitivity_code(wanted)
        return self._sensitivity_codes[wanted]

    def _new_sensitivity_code(self, wanted: tuple[int, ...]) -> CompiledFunction:
        step = _row_step(self.model)
        n_x, n = len(self.model.states), len(wanted)
        x, u, p, t, middle, h = step.sx_in()
        S, of_t, of_h = ca.SX.sym("S", n_x, n), ca.SX.sym("of_t", 1, n), ca.SX.sym("of_h", 1, n)
        after = step(x, u, p, t, middle, h)[0]
        S_after = (
            ca.mtimes(ca.jacobian(after, x), S)
            + ca.jacobian(after, p)[:, list(wanted)]
            + ca.mtimes(ca.jacobian(after, t), of_t)
            + ca.mtimes(ca.jacobian(after, h), of_h)
        )
        one = ca.Function("sensitivities", [x, S, u, p, t, middle, h, of_t, of_h], [after, S_after])
        return CompiledFunction(one, shared=[3], chained=2)

    @cached_property
    def _output_derivatives(self) -> CompiledFunction:
        """(x, u, p, t) -> dy/dx, dy/dp."""
        x, u, p, t, y = self.model.output_expressions()
        by = ca.Function("outputs_by", [x, u, p, t], [ca.jacobian(y, x), ca.jacobian(y, p)])
        return CompiledFunction(by, shared=[2])

    @cached_property
    def _complete(self) -> ArrayFunction:
        """(x without the states of `at_rest`, u, p, t) -> (x, its derivatives with respect to the argument and p)."""
        return ArrayFunction(with_derivatives(rest_function(self.model), 0, 2))

    @cached_property
    def _reset(self) -> ArrayFunction:
        """(x, u, p, t) -> (x after the jumps at a row, its derivatives with respect to x and p)."""
        return ArrayFunction(with_derivatives(reset_function(self.model), 0, 2))

    # --- simulation ---------------------------------------------------------------------------------------------

    def _complete_start(self, start: Array, inputs: Array, p: Array, time_min: Array) -> tuple[Array, Array, Array]:
        """Full state after the jumps at the first row, and its derivatives with respect to `start` and p."""
        x, by_start, by_p = start, np.eye(start.size), np.zeros((start.size, p.size))
        missing, model = start.size < len(self.model.states), self.model
        for function in (*((self._complete,) if missing else ()), *((self._reset,) if model.resets else ())):
            after, by_x, further = function.call(x, inputs[0], p, time_min[0])
            x, by_start, by_p = after[0], by_x.T @ by_start, by_x.T @ by_p + further.T
        return x, by_start, by_p

    def _grid(self, time_min: Array, p: Array) -> StepGrid:
        indices = [self.model.parameter_names.index(name) for name in self.model.breakpoints]
        return step_grid(time_min, p[indices])

    def _run_steps(self, grid: StepGrid, inputs: Array, start: Array, p: Array) -> tuple[Array, dict[int, Array]]:
        """State after each step, and the lengths into which steps were cut to keep the tolerance.

        The compiled steps run until one breaks the tolerance; from there on the stepper integrates until one step needs
        no cutting, and they resume after it.
        """
        steps = grid.length_min.size
        states, good = np.empty((steps, start.size)), np.empty(steps)
        columns = self._columns(grid, inputs)
        cuts: dict[int, Array] = {}
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
                x, lengths = self._stepper.integrate(x, inputs[grid.row[first]], p, float(t), float(h), float(middle))
                cutting = lengths.size > 1
                if cutting:
                    cuts[first] = lengths
                if self.model.resets and first in ends:
                    row = grid.row[first] + 1
                    x = self._stepper.start_row(x, inputs[row], p, float(t + h))
                states[first] = x
                first += 1
        return states, cuts

    def _run_sensitivities(
        self, grid: StepGrid, inputs: Array, start: Array, p: Array, wanted: list[int], initial: Array
    ) -> Array:
        """d(state after each step)/dp, shape (steps, n_x, n), on a grid that keeps the tolerance."""
        u, *times = self._columns(grid, inputs)
        code = self._sensitivity_code(tuple(wanted))
        results = code.allocate_results(grid.length_min.size)
        edges = self._edge_derivatives(grid, wanted)
        code.fill(grid.length_min.size, [start, np.ascontiguousarray(initial.T), u, p, *times, *edges], results)
        return results[1].transpose(0, 2, 1)

    def _columns(self, grid: StepGrid, inputs: Array) -> tuple[Array, Array, Array, Array]:
        """Arguments of every step: u as in `_row_step`, its start, the middle of its interval and its length."""
        u = inputs[grid.row]
        if self.model.resets:
            last = np.isin(np.arange(grid.row.size), grid.end_of_row)
            u = np.column_stack([u, inputs[grid.row + last], last])
        return np.ascontiguousarray(u, dtype=np.float64), grid.start_min, grid.middle_min, grid.length_min

    def _edge_derivatives(self, grid: StepGrid, wanted: list[int]) -> tuple[Array, Array]:
        """d(start of step)/dp and d(length of step)/dp, each of shape (steps, n)."""
        steps = grid.length_min.size
        of_time, of_length = np.zeros((steps, len(wanted))), np.zeros((steps, len(wanted)))
        for i, name in enumerate(self.model.breakpoints):
            index = self.model.parameter_names.index(name)
            if index not in wanted:
                continue
            column = wanted.index(index)
            opens, closes = grid.origin == i, grid.target == i
            of_length[opens, column] -= grid.share[opens]
            of_time[opens, column] += 1.0 - grid.share_before[opens]
            of_length[closes, column] += grid.share[closes]
            of_time[closes, column] += grid.share_before[closes]
        return of_time, of_length

    def _trajectory(self, time_min: Array, inputs: Array, p: Array, states: Array) -> Trajectory:
        (y,) = _compiled_outputs(self.model).map(states, inputs, p, time_min)
        return Trajectory(time_min, states, y[:, :, 0])

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
def _compiled_outputs(model: ProcessModel) -> CompiledFunction:
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
