"""All steady states of a model at a constant input, and their stability.

Newton's method, damped, from a lattice of starts over the physical range of the states, each start a column of one
compiled map; what they reach is put together. A fixed lattice, not random starts: the answer is the same every
time. For the reactor the result is held in a test against an exhaustive one-dimensional scan.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from reactorwatch.process.linearise import linearise
from reactorwatch.process.memory import rest_function
from reactorwatch.process.model import Array, ProcessModel

STARTS = 1024
ITERATIONS = 80
RESIDUAL = 1e-10  # scales per minute
SAME = 1e-6  # scales


@dataclass(frozen=True, eq=False)
class SteadyState:
    """A point at which nothing changes.

    Attributes:
        state: shape (n_x,).
        outputs: shape (n_y,).
        eigenvalues: of the linear model there, 1/min, shape (n_x,).
    """

    state: Array
    outputs: Array
    eigenvalues: NDArray[np.complex128]

    @property
    def stable(self) -> bool:
        """Whether small deviations die out."""
        return bool(np.all(self.eigenvalues.real < 0))

    @property
    def kind(self) -> str:
        """Node, focus or saddle, stable or not, in the words of the phase plane."""
        if np.any(self.eigenvalues.real > 0) and np.any(self.eigenvalues.real < 0):
            return "saddle"
        shape = "focus" if np.any(np.abs(self.eigenvalues.imag) > 0) else "node"
        return f"{'stable' if self.stable else 'unstable'} {shape}"


def steady_states(model: ProcessModel, inputs: Array, time_min: float = 0.0) -> list[SteadyState]:
    """All steady states within the bounds of the states.

    Args:
        model: the process.
        inputs: shape (n_u,), constant.
        time_min: when, for models with an effect that depends on time.

    Returns:
        By rising value of the last state that is not in `at_rest` (for the reactor: from extinguished to operating).

    Raises:
        ValueError: inputs that do not fit the model.
    """
    inputs = np.atleast_1d(np.asarray(inputs, dtype=float))
    if inputs.shape != (len(model.inputs),) or not np.all(np.isfinite(inputs)):
        raise ValueError(f"inputs must be {len(model.inputs)} finite numbers ({model.input_names}), got {inputs}")
    own = model.without_memory()
    scales = np.array([state.scale for state in own.states])
    lower = np.array([state.lower for state in own.states])
    upper = np.array([state.upper for state in own.states])
    x = lower[:, None] + _lattice(len(own.states)) * (upper - lower)[:, None]
    rhs, newton = _newton(own)
    fixed = (inputs, model.values(), time_min)
    for _ in range(ITERATIONS):
        step = np.nan_to_num(np.array(newton(x, *fixed)))
        # No step longer than a tenth of the range: far from a root Newton's direction is good, its length is not.
        length = np.max(np.abs(step) / (upper - lower)[:, None], axis=0)
        x = np.clip(x - step * np.minimum(1.0, 0.1 / np.maximum(length, 1e-300)), lower[:, None], upper[:, None])
    residual = np.max(np.abs(np.array(rhs(x, *fixed))) / scales[:, None], axis=0)
    found: list[Array] = []
    for point in x[:, residual < RESIDUAL].T:
        if all(np.max(np.abs(point - other) / scales) > SAME for other in found):
            found.append(point)
    function, completed = model.function(), rest_function(model)
    found = [np.array(completed(point, *fixed)).ravel() for point in sorted(found, key=lambda point: float(point[-1]))]
    return [
        SteadyState(
            point,
            np.array(function(point, *fixed, time_min)[1]).ravel(),
            linearise(model, point, inputs, time_min).eigenvalues,
        )
        for point in found
    ]


def _newton(model: ProcessModel) -> tuple[ca.Function, ca.Function]:
    """(x, u, p, t) -> dx/dt and -> Newton's step, each for all starts at once."""
    x, u, p = model.arguments()
    t = ca.SX.sym("t")
    rhs = ca.substitute(ca.vertcat(*model.rhs), model.clock.now, t)
    rhs = ca.substitute(rhs, model.clock.middle, t)
    balance = ca.Function("balance", [x, u, p, t], [rhs])
    newton = ca.Function("newton", [x, u, p, t], [ca.solve(ca.jacobian(rhs, x), rhs)])
    return balance.map(STARTS), newton.map(STARTS)


def _lattice(dimensions: int) -> Array:
    """Points spread evenly over the unit cube, shape (dimensions, STARTS): the R sequence.

    The additive recurrence with powers of 1/phi_d, phi_d the root of x^(d+1) = x + 1: Roberts (2018), The unreasonable
    effectiveness of quasirandom sequences; for d = 1 it is Kronecker's sequence of the golden ratio.
    """
    root = 2.0
    for _ in range(64):
        root = (1 + root) ** (1 / (dimensions + 1))
    powers = (1 / root) ** np.arange(1, dimensions + 1)
    return np.asarray((0.5 + powers[:, None] * np.arange(1, STARTS + 1)[None]) % 1.0, dtype=np.float64)
