"""Initial state of the plant, at the start of a run and after a change of its equations."""

from collections.abc import Mapping
from math import nextafter
from typing import Literal

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.steady_state import steady_states

BEFORE_MIN = nextafter(0.0, -1.0)
"""Last time before plant time 0: an onset at 0 does not affect the initial steady state."""

ITERATIONS = 50
TOLERANCE = 1e-9  # scales


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
    for _ in range(ITERATIONS):
        change = np.array(step(state, inputs, model.values(), time_min, time_min)).ravel()
        state[missing] -= change
        if np.all(np.abs(change) <= TOLERANCE * scales):
            return state
    names = ", ".join(model.states[index].name for index in missing)
    raise InputError(f"{model.name}: {names} cannot be at rest while {dict(known)}; give a start for them")


def _balance(model: ProcessModel, index: int) -> ca.SX:
    """Expression that is zero where a state is in equilibrium."""
    state = model.states[index]
    return state.symbol - model.at_rest[state.name] if state.name in model.at_rest else model.rhs[index]
