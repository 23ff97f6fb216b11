"""From a model and an input record to its trajectory, and to exact sensitivities of it.

Sensitivities are carried along with the state: with x' = Phi(x, p, h) over one step, S' = Phi_x S + Phi_p, where
the derivatives of the discrete step itself are taken symbolically. So they are the derivatives of exactly the numbers
that `simulate` returns, not of an approximation of the continuous system.

An onset is a parameter like any other here: it moves the edge between two steps, so it enters through their
lengths. Before it, dh/d(onset) = +1 for the stretch that ends there; after it, -1, and that stretch starts later.

States that jump when a row begins (`ProcessModel.resets`) do so at the end of the step that leads there, so what a run
shows of a row is the state after it has begun.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from reactorwatch.process.array_function import ArrayFunction, mapped, over_rows
from reactorwatch.process.integrate import TOLERANCE, StepGrid, Stepper, step_grid, symbolic_step
from reactorwatch.process.memory import reset_function, rest_function
from reactorwatch.process.model import Array, ProcessModel

CHUNK = 256
"""Steps in one compiled chain. All that comes after a step that breaks the tolerance is computed again."""

UNROLLED = 8
"""Steps that are one expression in the chain, for a call costs a third of a step. Divides `CHUNK`."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A simulated run.

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
        names: of the parameters.
        states: shape (rows, n_x, n_p).
        outputs: shape (rows, n_y, n_p).
    """

    names: tuple[str, ...]
    states: Array
    outputs: Array


class Simulator:
    """Free runs of one model; what is compiled for it is kept. Not for two threads at once.

    Args:
        model: the process.
    """

    def __init__(self, model: ProcessModel) -> None:
        self.model = model
        self._own = sum(state.name not in model.at_rest for state in model.states)
        self._stepper = Stepper(model)
        self._sensitivity_chains: dict[tuple[int, ...], ArrayFunction] = {}

    def run(
        self,
        time_min: Array,
        inputs: Array,
        start: Array,
        changes: Mapping[str, float] | None = None,
    ) -> Trajectory:
        """Run the equations freely from a start.

        Args:
            time_min: shape (rows,), increasing.
            inputs: shape (rows, n_u) or (rows,) for one input; row k holds over [t_k, t_k+1).
            start: state at the first time, shape (n_x,); or without the states of `ProcessModel.at_rest`, if these are
                behind the others: then they are at rest.
            changes: parameters that differ from the model's values.

        Raises:
            ValueError: shapes that do not fit, times that do not increase, NaN, an input or parameter out of bounds.
            SimulationError: the equations cannot be integrated further.
        """
        inputs, start, p = self._checked(time_min, inputs, start, changes)
        start, _, _ = self._begun(start, inputs, p, time_min)
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
        """A free run and its derivatives with respect to some parameters; arguments as for `run`.

        Args:
            time_min: shape (rows,).
            inputs: shape (rows, n_u) or (rows,).
            start: shape (n_x,), or shorter, as for `run`.
            names: the parameters to differentiate by.
            changes: parameters that differ from the model's values.
            start_sensitivity: d start / d parameters, shape (start.size, len(names)); zero if not given.

        Raises:
            ValueError: as `run`, or an unknown parameter.
            SimulationError: as `run`.
        """
        inputs, start, p = self._checked(time_min, inputs, start, changes)
        wanted = [self.model.parameter_names.index(self.model.parameter(name).name) for name in names]
        shape = (start.size, len(wanted))
        initial = np.zeros(shape) if start_sensitivity is None else np.array(start_sensitivity, dtype=float)
        if initial.shape != shape:
            raise ValueError(f"start_sensitivity must have shape {shape}, got {initial.shape}")
        start, by_start, by_p = self._begun(start, inputs, p, time_min)
        initial = by_start @ initial + by_p[:, wanted]
        grid = self._grid(time_min, p)
        states, cuts = self._run_steps(grid, inputs, start, p)
        trajectory = self._trajectory(time_min, inputs, p, np.vstack([start, states[grid.end_of_row]]))
        grid = grid.refined(cuts)
        of_states = self._run_sensitivities(grid, inputs, start, p, wanted, initial)
        of_states = np.concatenate([initial[None], of_states[grid.end_of_row]])
        by_x, by_p = self._over_rows(self._output_derivatives, time_min, inputs, p, trajectory.states)
        of_outputs: Array = by_x @ of_states + by_p[:, :, wanted]
        return trajectory, Sensitivities(tuple(names), of_states, of_outputs)

    # --- what is compiled once a model -----------------------------------------------------------------------

    @cached_property
    def _chain(self) -> ArrayFunction:
        """(x, U, p, t, t_middle, h) -> (states after each step, error of each)."""
        step = _row_step(self.model)
        few = step.mapaccum("few", UNROLLED).expand()
        symbols = self._chain_symbols()
        x, u, p, t, middle, h = symbols
        results = few.mapaccum("many", CHUNK // UNROLLED)(x, u, ca.repmat(p, 1, CHUNK), t, middle, h)
        return ArrayFunction(ca.Function("chain", symbols, list(results)))

    def _sensitivity_chain(self, wanted: tuple[int, ...]) -> ArrayFunction:
        """(x, U, p, t, t_middle, h, S, dt, dh) -> (states, sensitivities), for the parameters of these numbers."""
        if wanted not in self._sensitivity_chains:
            self._sensitivity_chains[wanted] = self._new_sensitivity_chain(wanted)
        return self._sensitivity_chains[wanted]

    def _new_sensitivity_chain(self, wanted: tuple[int, ...]) -> ArrayFunction:
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
        one = ca.Function("one", [x, S, u, p, t, middle, h, of_t, of_h], [after, ca.densify(S_after)])
        symbols = [
            *self._chain_symbols(),
            ca.MX.sym("S", n_x, n),
            ca.MX.sym("of_t", 1, CHUNK * n),
            ca.MX.sym("of_h", 1, CHUNK * n),
        ]
        X, U, P, T, M, H, SS, of_T, of_H = symbols
        results = one.mapaccum("steps", CHUNK, 2)(X, SS, U, ca.repmat(P, 1, CHUNK), T, M, H, of_T, of_H)
        return ArrayFunction(ca.Function("sensitivity_chain", symbols, list(results)))

    def _chain_symbols(self) -> list[ca.MX]:
        model = self.model
        sizes = (
            ("x", len(model.states), 1),
            ("u", len(model.inputs) * (2 if model.resets else 1) + bool(model.resets), CHUNK),
            ("p", len(model.parameters), 1),
            ("t", 1, CHUNK),
            ("t_middle", 1, CHUNK),
            ("h", 1, CHUNK),
        )
        return [ca.MX.sym(*size) for size in sizes]

    @cached_property
    def _outputs(self) -> ArrayFunction:
        """Rows of (x, u, p, t) -> y."""
        x, u, p, t, y = self._output_expressions()
        return mapped(ca.Function("outputs", [x, u, p, t], [y]), CHUNK, parameters=2)

    @cached_property
    def _output_derivatives(self) -> ArrayFunction:
        """Rows of (x, u, p, t) -> dy/dx, dy/dp."""
        x, u, p, t, y = self._output_expressions()
        by = ca.Function("outputs_by", [x, u, p, t], [ca.jacobian(y, x), ca.jacobian(y, p)])
        return mapped(by, CHUNK, parameters=2)

    def _output_expressions(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
        """The symbols x, u, p, t and y in terms of them."""
        model, t = self.model, ca.SX.sym("t")
        x, u, p = model.arguments()
        y = ca.vertcat(*(output.expression for output in model.outputs))
        return x, u, p, t, ca.substitute(ca.substitute(y, model.clock.now, t), model.clock.middle, t)

    @cached_property
    def _complete(self) -> ArrayFunction:
        """(x without the states of `at_rest`, u, p, t) -> (x, its derivatives by x without them and by p)."""
        return ArrayFunction(_with_derivatives(rest_function(self.model)))

    @cached_property
    def _reset(self) -> ArrayFunction:
        """(x, u, p, t) -> (x when a row has begun, its derivatives by x and by p)."""
        return ArrayFunction(_with_derivatives(reset_function(self.model)))

    # --- running ---------------------------------------------------------------------------------------------

    def _begun(self, start: Array, inputs: Array, p: Array, time_min: Array) -> tuple[Array, Array, Array]:
        """The whole state when the first row has begun, and its derivatives by the start that is given and by p."""
        x, by_start, by_p = start, np.eye(start.size), np.zeros((start.size, p.size))
        missing, model = start.size < len(self.model.states), self.model
        for function in (*((self._complete,) if missing else ()), *((self._reset,) if model.resets else ())):
            for argument, value in zip(function.arguments, (x, inputs[0], p, time_min[:1]), strict=True):
                argument[0] = value
            function()
            after, by_x, further = function.results
            x, by_start, by_p = after[0].copy(), by_x.T @ by_start, by_x.T @ by_p + further.T
        return x, by_start, by_p

    def _grid(self, time_min: Array, p: Array) -> StepGrid:
        indices = [self.model.parameter_names.index(name) for name in self.model.breakpoints]
        return step_grid(time_min, p[indices])

    def _run_steps(self, grid: StepGrid, inputs: Array, start: Array, p: Array) -> tuple[Array, dict[int, Array]]:
        """The state after each step, and which steps had to be cut into what to keep the tolerance.

        The chain runs until a step breaks the tolerance; from there on the stepper walks until one step needs no
        cutting, and the chain goes on after it.
        """
        steps = grid.length_min.size
        states = np.empty((steps, start.size))
        cuts: dict[int, Array] = {}
        x, first, ends = start, 0, set(grid.end_of_row.tolist())
        while first < steps:
            part = slice(first, min(first + CHUNK, steps))
            count = self._fill(self._chain, grid, inputs, p, x, part)
            self._chain()
            after, error = (result[:count] for result in self._chain.results)
            bad = ~((error[:, 0] <= TOLERANCE) & np.isfinite(after).all(axis=1))
            good = int(np.argmax(bad)) if bad.any() else count
            states[first : first + good] = after[:good]
            first += good
            x = states[first - 1] if first else start
            walking = good < count
            while walking and first < steps:
                t, h, middle = grid.start_min[first], grid.length_min[first], grid.middle_min[first]
                x, lengths = self._stepper.walk(x, inputs[grid.row[first]], p, float(t), float(h), float(middle))
                walking = lengths.size > 1
                if walking:
                    cuts[first] = lengths
                if self.model.resets and first in ends:
                    row = grid.row[first] + 1
                    x = self._stepper.begin_row(x, inputs[row], p, float(t + h))
                states[first] = x
                first += 1
        return states, cuts

    def _run_sensitivities(
        self, grid: StepGrid, inputs: Array, start: Array, p: Array, wanted: list[int], initial: Array
    ) -> Array:
        """d(state after each step)/dp, shape (steps, n_x, n), on a grid that keeps the tolerance."""
        n_x, n = initial.shape
        of_time, of_length = self._edge_derivatives(grid, wanted)
        chain = self._sensitivity_chain(tuple(wanted))
        *_, sensitivity, chain_of_time, chain_of_length = chain.arguments
        sensitivity[:] = initial.T
        steps = grid.length_min.size
        result = np.empty((steps, n_x, n))
        x = start
        for first in range(0, steps, CHUNK):
            part = slice(first, min(first + CHUNK, steps))
            count = self._fill(chain, grid, inputs, p, x, part)
            chain_of_time.reshape(CHUNK, n)[:count] = of_time[part]
            chain_of_length.reshape(CHUNK, n)[:count] = of_length[part]
            chain()
            states, sensitivities = chain.results
            after = sensitivities.reshape(CHUNK, n, n_x)
            result[part] = after[:count].transpose(0, 2, 1)
            x, sensitivity[:] = states[count - 1], after[count - 1]
        return result

    def _fill(self, chain: ArrayFunction, grid: StepGrid, inputs: Array, p: Array, x: Array, part: slice) -> int:
        """Put some steps into the arguments that both chains begin with; returns how many they are."""
        count = int(part.stop - part.start)
        state, u, parameters, time, middle, length = chain.arguments[:6]
        state[0], parameters[0] = x, p
        n_u = inputs.shape[1]
        u[:count, :n_u] = inputs[grid.row[part]]
        if self.model.resets:
            last = np.isin(np.arange(part.start, part.stop), grid.end_of_row)
            u[:count, n_u:-1], u[:count, -1] = inputs[grid.row[part] + last], last
        time[:count, 0] = grid.start_min[part]
        middle[:count, 0] = grid.middle_min[part]
        length[:count, 0] = grid.length_min[part]
        return count

    def _edge_derivatives(self, grid: StepGrid, wanted: list[int]) -> tuple[Array, Array]:
        """d(start of step)/dp and d(length of step)/dp, each of shape (steps, n)."""
        steps = grid.length_min.size
        of_time, of_length = np.zeros((steps, len(wanted))), np.zeros((steps, len(wanted)))
        for number, name in enumerate(self.model.breakpoints):
            index = self.model.parameter_names.index(name)
            if index not in wanted:
                continue
            column = wanted.index(index)
            opens, closes = grid.origin == number, grid.target == number
            of_length[opens, column] -= grid.share[opens]
            of_time[opens, column] += 1.0 - grid.share_before[opens]
            of_length[closes, column] += grid.share[closes]
            of_time[closes, column] += grid.share_before[closes]
        return of_time, of_length

    def _trajectory(self, time_min: Array, inputs: Array, p: Array, states: Array) -> Trajectory:
        (y,) = self._over_rows(self._outputs, time_min, inputs, p, states)
        return Trajectory(time_min, states, y[:, :, 0])

    def _over_rows(
        self, function: ArrayFunction, time_min: Array, inputs: Array, p: Array, states: Array
    ) -> list[Array]:
        """Results of a function of (x, u, p, t) for every row, each of shape (rows, its rows, its columns)."""
        return over_rows(function, CHUNK, p, (states, inputs, time_min[:, None]))

    def _checked(
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
        if start.shape not in ((len(model.states),), (self._own,)) or not np.all(np.isfinite(start)):
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
    """One step; if the model has resets, u is the input, that of the row after, and 1 where the step ends a row."""
    step = symbolic_step(model)
    if not model.resets:
        return step
    x, u, p, t, middle, h = step.sx_in()
    following, last = ca.SX.sym("u_next", u.numel()), ca.SX.sym("last")
    after, error = step(x, u, p, t, middle, h)
    after = ca.if_else(last, reset_function(model)(after, following, p, t + h), after)
    return ca.Function("row_step", [x, ca.vertcat(u, following, last), p, t, middle, h], [after, error])


def _with_derivatives(function: ca.Function) -> ca.Function:
    """Of one vector of results: it, and its derivatives by the first and the third argument."""
    symbols = function.sx_in()
    result = function(*symbols)
    derivatives = (ca.densify(ca.jacobian(result, symbols[place])) for place in (0, 2))
    return ca.Function(function.name(), symbols, [result, *derivatives])
