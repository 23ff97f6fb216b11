"""Simulation of a model over an input record.

States that jump when a row begins (`ProcessModel.resets`) do so at the end of the step before, so a trajectory has the
state after the jump.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import inf

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.array_function import ArrayFunction
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.process.effect_states import reset_function, rest_function
from reactorwatch.process.integrate import TOLERANCE, StepGrid, Stepper, symbolic_step
from reactorwatch.process.model import ProcessModel


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
            start = self._complete.call(start, inputs[0], p, time_min[0])[0][0]
        start = self._stepper.start_row(start, inputs[0], p, float(time_min[0]))
        grid = StepGrid(time_min, self._stepper.breakpoints(p))
        states = np.vstack([start, self._run_steps(grid, inputs, start, p)[grid.end_of_row]])
        (y,) = self._outputs.map(states, inputs, p, time_min)
        return Trajectory(time_min, states, y[:, :, 0])

    # --- compiled once a model -----------------------------------------------------------------------

    @cached_property
    def _code(self) -> CompiledFunction:
        """(x, u, p, t, t_middle, h) -> (state after the step, 1 if it keeps the tolerance), step after step."""
        step = _row_step(self.model)
        after, error = step(*step.sx_in())
        good = ca.logic_and(error <= TOLERANCE, ca.fabs(ca.sum1(after)) < inf)
        return CompiledFunction(ca.Function("step", step.sx_in(), [after, good]), shared=[2], chained=1, stops=True)

    @cached_property
    def _outputs(self) -> CompiledFunction:
        """(x, u, p, t) -> y."""
        x, u, p, t, y = self.model.output_expressions()
        return CompiledFunction(ca.Function("outputs", [x, u, p, t], [y]), shared=[2])

    @cached_property
    def _complete(self) -> ArrayFunction:
        """(x without the states of `at_rest`, u, p, t) -> x."""
        return ArrayFunction(rest_function(self.model))

    # --- simulation ---------------------------------------------------------------------------------------------

    def _run_steps(self, grid: StepGrid, inputs: Array, start: Array, p: Array) -> Array:
        """State after each step.

        The compiled steps run until one breaks the tolerance; from there on the stepper integrates until one step needs
        no cutting, and they resume after it.
        """
        steps = grid.length_min.size
        states, good = np.empty((steps, start.size)), np.empty(steps)
        columns = self._columns(grid, inputs)
        x, first, ends = start, 0, set(grid.end_of_row.tolist())
        while first < steps:
            u, *times = (column[first:] for column in columns)
            done = self._code.fill(steps - first, [x, u, p, *times], [states[first:], good[first:]])
            first += done
            x = states[first - 1] if first else start
            cutting = True
            while cutting and first < steps:
                t, h, middle = grid.start_min[first], grid.length_min[first], grid.middle_min[first]
                x, lengths = self._stepper.integrate(x, inputs[grid.row[first]], p, float(t), float(h), float(middle))
                cutting = lengths.size > 1
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
