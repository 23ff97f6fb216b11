"""Steady states of a model at a constant input with their stability, and the initial state of a run.

Damped Newton's method from a lattice of starts over the physical range of the states, in machine code; coinciding
results are merged. The lattice is fixed, not random: the answer is the same every time. For the reactor a test compares
the result with an exhaustive one-dimensional scan.

A linear model is a first-order Taylor expansion with symbolic derivatives. Its error falls with the square of the step,
so halving the step halves the error relative to the response; its size at a given step shows whether the linear model
is useful there.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import inf, nextafter
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.errors import InputError
from reactorwatch.process.model import MODEL_CACHE_SIZE, ProcessModel
from reactorwatch.process.simulate import Simulator, rest_function

STARTS = 1024  # of the lattice: some 30 a side in two dimensions, 10 in three


@dataclass(frozen=True, eq=False)
class SteadyState:
    """A steady state.

    Attributes:
        state: shape (n_x,).
        outputs: shape (n_y,).
        eigenvalues: eigenvalues of the linear model, 1/min, shape (n_x,).
    """

    state: Array
    outputs: Array
    eigenvalues: NDArray[np.complex128]

    @property
    def stable(self) -> bool:
        """True if small deviations decay."""
        return bool(np.all(self.eigenvalues.real < 0))

    @property
    def kind(self) -> str:
        """Type in the phase plane: stable or unstable node or focus, or saddle."""
        if np.any(self.eigenvalues.real > 0) and np.any(self.eigenvalues.real < 0):
            return "saddle"
        shape = "focus" if np.any(np.abs(self.eigenvalues.imag) > 0) else "node"
        return f"{'stable' if self.stable else 'unstable'} {shape}"


def steady_states(model: ProcessModel, inputs: Array, time_min: float = 0.0) -> list[SteadyState]:
    """All steady states within the bounds of the states; see `SteadyStates.at`.

    Args:
        model: the process.
        inputs: shape (n_u,), constant.
        time_min: time, for models with time-dependent effects.

    Raises:
        ValueError: inputs that do not fit the model.
    """
    return SteadyStates(model).at(inputs, time_min)


class SteadyStates:
    """Finds the steady states of one model; keeps its compiled code.

    Args:
        model: the process.
    """

    def __init__(self, model: ProcessModel) -> None:
        core = model.without_effect_states
        self._model = model
        self._scales = np.array([state.scale for state in core.states])
        lower, upper = (np.array([getattr(state, name) for state in core.states]) for name in ("lower", "upper"))
        self._starts = lower + _lattice(len(core.states)).T * (upper - lower)
        self._search = CompiledFunction(_search_step(core), shared=[1, 2, 3])
        self._outputs = model.function()
        self._complete = rest_function(model)

    def at(self, inputs: Array, time_min: float = 0.0, changes: Mapping[str, float] | None = None) -> list[SteadyState]:
        """All steady states within the bounds of the states.

        Args:
            inputs: shape (n_u,), constant.
            time_min: time, for models with time-dependent effects.
            changes: parameters that differ from the model's values.

        Returns:
            Steady states by increasing value of the last output (for the reactor: from extinguished to operating).

        Raises:
            ValueError: inputs that do not fit the model.
        """
        model, inputs = self._model, np.atleast_1d(np.asarray(inputs, dtype=float))
        if inputs.shape != (len(model.inputs),) or not np.all(np.isfinite(inputs)):
            raise ValueError(f"inputs must be {len(model.inputs)} finite numbers ({model.input_names}), got {inputs}")
        fixed = (inputs, model.values(changes), time_min)
        points = []
        for point in self._roots(*fixed):
            state = np.array(self._complete(point, *fixed)).ravel()
            outputs = np.array(self._outputs(state, *fixed, time_min)[1]).ravel()
            points.append(SteadyState(state, outputs, linearise(model, state, inputs, time_min, changes).eigenvalues))
        return sorted(points, key=lambda point: float(point.outputs[-1]))

    def _roots(self, inputs: Array, p: Array, time_min: float) -> list[Array]:
        """Distinct roots of the balances, without the states in `at_rest`."""
        fixed = (inputs, p, np.array([time_min]))
        x = self._starts.copy()
        searching = np.arange(len(x))
        for _ in range(20):  # what still moves then does not converge
            now = after = x[searching]
            for _ in range(4):  # most end in a cycle of two or four points that differ by rounding
                after = self._search.map(after, *fixed)[0][:, :, 0]
            x[searching] = after
            searching = searching[np.any(after != now, axis=1)]
            if not searching.size:
                break
        rate = self._search.map(x, *fixed)[1][:, :, 0]
        roots = x[np.max(np.abs(rate) / self._scales, axis=1) < 1e-10]  # scales a minute
        distinct = []
        while len(roots):
            distinct.append(roots[0])
            roots = roots[np.max(np.abs(roots - roots[0]) / self._scales, axis=1) > 1e-6]  # scales
        return distinct


def _search_step(model: ProcessModel) -> ca.Function:
    """(x, u, p, t) -> x after a damped step of Newton's method, and dx/dt before it."""
    x, u, p, t, rhs = model.at_one_time(ca.vertcat(*model.rhs))
    lower, upper = (ca.DM([getattr(state, name) for state in model.states]) for name in ("lower", "upper"))
    step = ca.solve(ca.jacobian(rhs, x), rhs)
    step = ca.if_else(ca.fabs(step) < inf, step, 0)
    # No step longer than a tenth of the range: far from a root Newton's direction is good, its length is not.
    length = ca.mmax(ca.fabs(step) / (upper - lower))
    after = ca.fmin(ca.fmax(x - step * ca.fmin(1, 0.1 / ca.fmax(length, 1e-300)), lower), upper)
    return ca.Function("search", [x, u, p, t], [after, rhs])


def _lattice(dimensions: int) -> Array:
    """Points of the R sequence, evenly spread over the unit cube, shape (dimensions, STARTS).

    The additive recurrence with powers of 1/phi_d, phi_d the root of x^(d+1) = x + 1: Roberts (2018), The unreasonable
    effectiveness of quasirandom sequences; for d = 1 it is Kronecker's sequence of the golden ratio.
    """
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (dimensions + 1))
    powers = (1 / root) ** np.arange(1, dimensions + 1)
    return np.asarray((0.5 + powers[:, None] * np.arange(1, STARTS + 1)[None]) % 1.0, dtype=np.float64)


BEFORE_MIN = nextafter(0.0, -1.0)
"""Last time before plant time 0: an onset at 0 does not affect the initial steady state."""


def start_state(
    model: ProcessModel, inputs: Array, start: Literal["operating", "extinguished"] | Mapping[str, float]
) -> Array:
    """Initial state of a run.

    Args:
        model: the process, with its initial faults.
        inputs: inputs of the first row, shape (n_u,).
        start: `operating` or `extinguished` for the steady state at these inputs with the largest or smallest last
            output, or values of the states by name.

    Returns:
        Shape (n_x,).

    Raises:
        InputError: an unknown state, a value out of its bounds, or no steady state at these inputs.
    """
    if isinstance(start, Mapping):
        for name, value in start.items():
            if name not in model.state_names:
                raise InputError(f"start: {model.name} has no state {name!r} (valid: {', '.join(model.state_names)})")
            state = model.states[model.state_names.index(name)]
            if not state.lower <= value <= state.upper:
                raise InputError(
                    f"start: {name} must be in [{state.lower:g}, {state.upper:g}] {state.unit}, got {value:g}"
                )
        return complete_state(model, start, inputs, BEFORE_MIN)
    points = steady_states(model, inputs, BEFORE_MIN)
    if not points:
        given = ", ".join(f"{item.name} = {value:g}" for item, value in zip(model.inputs, inputs, strict=True))
        example = ", ".join(f"{item.name} = {0.5 * (item.lower + item.upper):g}" for item in model.states)
        raise InputError(f"start: {model.name} has no steady state at {given}; give the states, like {{{example}}}")
    return points[-1 if start == "operating" else 0].state


def complete_state(model: ProcessModel, known: Mapping[str, float], inputs: Array, time_min: float) -> Array:
    """Complete a state of which some values are known.

    The others, such as the position of a valve that had no inertia before, are in equilibrium with the known ones:
    Newton's method on their balances.

    Args:
        model: the process.
        known: values by name; names that the model lacks are left out.
        inputs: shape (n_u,).
        time_min: time.

    Returns:
        Shape (n_x,).

    Raises:
        InputError: the others have no equilibrium.
    """
    state = np.array([known.get(item.name, 0.5 * (item.lower + item.upper)) for item in model.states])
    missing = [index for index, item in enumerate(model.states) if item.name not in known]
    if not missing:
        return state
    free = ca.vertcat(*(model.states[index].symbol for index in missing))
    balance = ca.vertcat(*(_balance(model, index) for index in missing))
    step = ca.Function(
        "step",
        [*model.arguments(), model.clock.now, model.clock.middle],
        [ca.solve(ca.jacobian(balance, free), balance)],
    )
    scales = np.array([model.states[index].scale for index in missing])
    for _ in range(50):
        change = np.array(step(state, inputs, model.values(), time_min, time_min)).ravel()
        state[missing] -= change
        if np.all(np.abs(change) <= 1e-9 * scales):
            return state
    names = ", ".join(model.states[index].name for index in missing)
    raise InputError(f"{model.name}: {names} cannot be at rest while {dict(known)}; give a start for them")


def _balance(model: ProcessModel, index: int) -> ca.SX:
    """Expression that is zero where a state is in equilibrium."""
    state = model.states[index]
    return state.symbol - model.at_rest[state.name] if state.name in model.at_rest else model.rhs[index]


@dataclass(frozen=True, eq=False)
class Linearization:
    """d(dx)/dt = A dx + B du, dy = C dx + D du, for deviations from the point.

    Attributes:
        A: shape (n_x, n_x), 1/min where the states share a unit.
        B: shape (n_x, n_u).
        C: shape (n_y, n_x).
        D: shape (n_y, n_u).
    """

    A: Array
    B: Array
    C: Array
    D: Array

    @property
    def eigenvalues(self) -> NDArray[np.complex128]:
        """Eigenvalues of A, in 1/min, shape (n_x,), by increasing real part."""
        values = np.linalg.eigvals(self.A).astype(np.complex128)
        return values[np.lexsort((values.imag, values.real))]


def linearise(
    model: ProcessModel,
    state: Array,
    inputs: Array,
    time_min: float = 0.0,
    changes: Mapping[str, float] | None = None,
) -> Linearization:
    """Linearise a model at a point, which need not be a steady state.

    Args:
        model: the process.
        state: shape (n_x,).
        inputs: shape (n_u,).
        time_min: time, for models with time-dependent effects.
        changes: parameters that differ from the model's values.
    """
    matrices = _derivatives(model)(state, inputs, model.values(changes), time_min, time_min)
    return Linearization(*map(np.array, matrices))


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def _derivatives(model: ProcessModel) -> ca.Function:
    """(x, u, p, t, t_middle) -> A, B, C, D."""
    x, u, p = model.arguments()
    clock = model.clock
    rhs = ca.vertcat(*model.rhs)
    y = ca.vertcat(*(output.expression for output in model.outputs))
    return ca.Function(
        "linear",
        [x, u, p, clock.now, clock.middle],
        [ca.jacobian(rhs, x), ca.jacobian(rhs, u), ca.jacobian(y, x), ca.jacobian(y, u)],
    )


@dataclass(frozen=True, eq=False)
class StepComparison:
    """Step responses of the plant and of the linear model, from a steady state.

    Attributes:
        time_min: time since the step, shape (rows,).
        plant: deviations of the plant's outputs from the steady state, shape (rows, n_y).
        linear: deviations of the linear model's outputs, shape (rows, n_y).
    """

    time_min: Array
    plant: Array
    linear: Array

    @property
    def error(self) -> Array:
        """Root mean square error relative to the plant's response, shape (n_y,)."""
        difference = np.sqrt(np.mean((self.linear - self.plant) ** 2, axis=0))
        size: Array = difference / np.sqrt(np.mean(self.plant**2, axis=0))
        return size


def step_response(linear: Linearization, step: Array, time_min: Array) -> Array:
    """Exact step response of a linear model's outputs, shape (rows, n_y).

    The exponential of the matrix [[A, B u], [0, 0]] steps the state over an interval with u constant: Van Loan (1978),
    Computing integrals involving the matrix exponential, IEEE Trans. Automatic Control 23(3).

    Args:
        linear: the linear model.
        step: shape (n_u,).
        time_min: shape (rows,), from 0 on.
    """
    n_x = linear.A.shape[0]
    block = np.zeros((n_x + 1, n_x + 1))
    block[:n_x, :n_x], block[:n_x, n_x] = linear.A, linear.B @ step
    states = np.array([expm(block * t)[:n_x, n_x] for t in time_min])
    response: Array = states @ linear.C.T + linear.D @ step
    return response


def compare_step(
    model: ProcessModel, state: Array, inputs: Array, step: Array, span_min: float = 10.0, period_min: float = 0.1
) -> StepComparison:
    """Compare the step responses of plant and linear model at a steady state.

    Args:
        model: the process.
        state: a steady state at `inputs`, shape (n_x,).
        inputs: inputs before the step, shape (n_u,).
        step: change of the inputs, shape (n_u,).
        span_min: length of the response.
        period_min: sampling period.

    Raises:
        ValueError: the stepped input is outside its bounds.
    """
    time_min: Array = np.arange(round(span_min / period_min) + 1, dtype=np.float64) * period_min
    outputs = np.array(model.function()(state, inputs, model.values(), 0.0, 0.0)[1]).ravel()
    stepped = np.tile(inputs + step, (time_min.size, 1))
    plant = Simulator(model).run(time_min, stepped, state).outputs - outputs
    return StepComparison(time_min, plant, step_response(linearise(model, state, inputs), step, time_min))
