"""All steady states of a model at a constant input, and their stability.

Damped Newton's method from a lattice of starts over the physical range of the states, in machine code; coinciding
results are merged. The lattice is fixed, not random: the answer is the same every time. For the reactor a test compares
the result with an exhaustive one-dimensional scan.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import CompiledFunction
from reactorwatch.process.effect_states import rest_function
from reactorwatch.process.linearise import linearise
from reactorwatch.process.model import ProcessModel

STARTS = 1024
ITERATIONS = 80
RESIDUAL = 1e-10  # scales per minute
SAME = 1e-6  # scales


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
        for _ in range(ITERATIONS):
            after = self._search.map(x[searching], *fixed)[0][:, :, 0]
            moved = np.any(after != x[searching], axis=1)
            x[searching] = after
            searching = searching[moved]
            if not searching.size:
                break
        rate = self._search.map(x, *fixed)[1][:, :, 0]
        roots = x[np.max(np.abs(rate) / self._scales, axis=1) < RESIDUAL]
        distinct = []
        while len(roots):
            distinct.append(roots[0])
            roots = roots[np.max(np.abs(roots - roots[0]) / self._scales, axis=1) > SAME]
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
