"""Meanings, roles and steady states of signals, from the catalogue of processes. Pure."""

import math
from collections.abc import Mapping
from functools import cache, lru_cache

import numpy as np

from reactorwatch.process import MODELS
from reactorwatch.process.model import ProcessModel, Variable
from reactorwatch.process.steady_state import SteadyState, steady_states

MAX_POINTS = 32
"""Largest number of points of a branch."""
FARTHEST = 2.0
"""Largest distance between neighbouring points of a branch, in scales of the states."""


def signal_title(name: str, unit: str) -> str:
    """Name of a signal, with its meaning if a process has a signal of that name and unit."""
    meaning = next((item.meaning for item in _variables() if (item.name, item.unit) == (name, unit)), "")
    return f"{name}: {meaning}" if meaning else name


def is_input(name: str) -> bool:
    """True for an input, which is held between its samples."""
    return any(item.name == name for model in _models() for item in model.inputs)


def find_process(units: Mapping[str, str]) -> ProcessModel | None:
    """Process whose inputs and outputs are all present, with the same units; None if there is none.

    Args:
        units: units of the present signals, by name.
    """
    return next((model for model in _models() if model.units.items() <= units.items()), None)


@lru_cache(maxsize=256)
def steady_states_at(name: str, level: float) -> tuple[SteadyState, ...]:
    """All steady states of a process with one input; the last is the operating point.

    Args:
        name: name of the process.
        level: level of its input.
    """
    return tuple(steady_states(_model(name), np.array([level])))


def operating_branch(name: str, lowest: float, highest: float, level: float) -> list[SteadyState]:
    """Steady states of the operating branch between two levels of the input.

    Args:
        name: name of a process with one input.
        lowest: lowest level of the input.
        highest: highest level of the input.
        level: operating level of the input.

    Returns:
        The steady states by rising level, as far as the branch extends. The grid of levels does not depend on the ends
        unless they are far apart. Empty if the process has no steady state at `level`.
    """
    bounds = _model(name).inputs[0]
    if not bounds.lower <= level <= bounds.upper:
        return []
    lowest, highest = max(lowest, bounds.lower), min(highest, bounds.upper)
    step = 10.0 ** math.floor(math.log10(max(abs(level), 1e-9))) / 40
    while (highest - lowest) / step > MAX_POINTS:
        step *= 2.0
    first, last, start = math.ceil(lowest / step), math.floor(highest / step), round(level / step)
    operating = steady_states_at(name, start * step)[-1:]
    if not operating:
        return []
    below = _continue_branch(name, operating[0], [index * step for index in range(start - 1, first - 1, -1)])
    above = _continue_branch(name, operating[0], [index * step for index in range(start + 1, last + 1)])
    return [*reversed(below), *operating, *above]


def _continue_branch(name: str, state: SteadyState, levels: list[float]) -> list[SteadyState]:
    """Continue the branch of a steady state from level to level until it ends."""
    scale = np.array([variable.scale for variable in _model(name).states])
    branch: list[SteadyState] = []
    for level in levels:
        candidates = steady_states_at(name, level)
        distances = [float(np.linalg.norm((item.state - state.state) / scale)) for item in candidates]
        if not candidates or min(distances) > FARTHEST:
            break
        state = candidates[int(np.argmin(distances))]
        branch.append(state)
    return branch


def _model(name: str) -> ProcessModel:
    return next(model for model in _models() if model.name == name)


@cache
def _models() -> tuple[ProcessModel, ...]:
    return tuple(build() for build in MODELS)


def _variables() -> list[Variable]:
    return [item for model in _models() for item in (*model.inputs, *model.states)]
