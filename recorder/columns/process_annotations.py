"""Meanings, roles and steady states of signals, from their process or the catalogue of processes. Pure."""

import math
from collections.abc import Mapping
from functools import cache, lru_cache

import numpy as np

from reactorwatch.description.process import Process
from reactorwatch.process import MODELS
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.steady_state import SteadyState, steady_states

MAX_POINTS = 32
"""Largest number of points of a branch."""
FARTHEST = 2.0
"""Largest distance between neighbouring points of a branch, in scales of the states."""


def signal_title(name: str, unit: str, process: Process | None = None) -> str:
    """Name of a signal, with its meaning if its process has a variable of that name.

    Args:
        name: name of the signal.
        unit: unit of the signal.
        process: process of the signal; None: any of the catalogue whose variable has this unit, too.
    """
    variables = [
        item
        for model in _models_of(process)
        for item in (*model.inputs, *model.states)
        if item.name == name and (item.unit == unit or process is not None)
    ]
    meaning = variables[0].meaning if variables else ""
    return f"{name}: {meaning}" if meaning else name


def signal_roles(units: Mapping[str, str], process: Process | None = None) -> dict[str, str]:
    """Roles of signals by name: those of the process in its order, then all others as outputs.

    Args:
        units: units of the signals, by name; empty: unknown.
        process: process of the signals; None: the one of the catalogue that has all of them, or all of whose signals
            are there.
    """
    if process is not None:
        roles = {signal.name: signal.role for signal in process.signals}
    else:
        model = find_model(units) or _find_model_with(units)
        roles = {} if model is None else {name: _role(model, name) for name in model.units}
    return {
        **{name: role for name, role in roles.items() if name in units},
        **{name: "output" for name in units if name not in roles},
    }


def find_model(units: Mapping[str, str], process: Process | None = None) -> ProcessModel | None:
    """Equations whose inputs and outputs are all present, with the same units; None if there are none.

    Args:
        units: units of the present signals, by name.
        process: process of the signals; None: any of the catalogue.
    """
    return next((model for model in _models_of(process) if model.units.items() <= units.items()), None)


@lru_cache(maxsize=256)
def steady_states_at(model: ProcessModel, level: float) -> tuple[SteadyState, ...]:
    """All steady states of a process with one input; the last is the operating point.

    Args:
        model: the process.
        level: level of its input.
    """
    return tuple(steady_states(model, np.array([level])))


def operating_branch(model: ProcessModel, lowest: float, highest: float, level: float) -> list[SteadyState]:
    """Steady states of the operating branch between two levels of the input.

    Args:
        model: a process with one input.
        lowest: lowest level of the input.
        highest: highest level of the input.
        level: operating level of the input.

    Returns:
        The steady states by rising level, as far as the branch extends. The grid of levels does not depend on the ends
        unless they are far apart. Empty if the process has no steady state at `level`.
    """
    bounds = model.inputs[0]
    if not bounds.lower <= level <= bounds.upper:
        return []
    lowest, highest = max(lowest, bounds.lower), min(highest, bounds.upper)
    step = 10.0 ** math.floor(math.log10(max(abs(level), 1e-9))) / 40
    while (highest - lowest) / step > MAX_POINTS:
        step *= 2.0
    first, last, start = math.ceil(lowest / step), math.floor(highest / step), round(level / step)
    operating = steady_states_at(model, start * step)[-1:]
    if not operating:
        return []
    below = _continue_branch(model, operating[0], [index * step for index in range(start - 1, first - 1, -1)])
    above = _continue_branch(model, operating[0], [index * step for index in range(start + 1, last + 1)])
    return [*reversed(below), *operating, *above]


def _continue_branch(model: ProcessModel, state: SteadyState, levels: list[float]) -> list[SteadyState]:
    """Continue the branch of a steady state from level to level until it ends."""
    scale = np.array([variable.scale for variable in model.states])
    branch: list[SteadyState] = []
    for level in levels:
        candidates = steady_states_at(model, level)
        distances = [float(np.linalg.norm((item.state - state.state) / scale)) for item in candidates]
        if not candidates or min(distances) > FARTHEST:
            break
        state = candidates[int(np.argmin(distances))]
        branch.append(state)
    return branch


def _find_model_with(units: Mapping[str, str]) -> ProcessModel | None:
    """Model of the catalogue that has all of the signals, none of them in another unit."""
    for model in _models():
        if all(name in model.units and unit in ("", model.units[name]) for name, unit in units.items()):
            return model
    return None


def _role(model: ProcessModel, name: str) -> str:
    return "input" if name in model.input_names else "output"


def _models_of(process: Process | None) -> tuple[ProcessModel, ...]:
    """Equations of a process; without its own, those of the catalogue under its name."""
    if process is None:
        return _models()
    if process.model is not None:
        return (process.model,)
    return tuple(model for model in _models() if model.name == process.name)


@cache
def _models() -> tuple[ProcessModel, ...]:
    return tuple(build() for build in MODELS)
