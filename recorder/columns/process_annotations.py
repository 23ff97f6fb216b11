"""What is known of the signals of a run from the equations of the processes there are. Pure."""

import math
from collections.abc import Mapping
from functools import cache, lru_cache

import numpy as np

from reactorwatch.process import MODELS
from reactorwatch.process.model import ProcessModel, Variable
from reactorwatch.process.steady_state import SteadyState, steady_states

MOST_POINTS = 32
"""Of a branch."""
FARTHEST = 2.0
"""In scales of the states: what is farther from one level of the input to the next is another branch."""


def titled(name: str, unit: str) -> str:
    """A signal's name with what it means, if a process knows a signal of that name and unit."""
    meaning = next((item.meaning for item in _variables() if (item.name, item.unit) == (name, unit)), "")
    return f"{name}: {meaning}" if meaning else name


def is_input(name: str) -> bool:
    """Whether a signal is an input, which holds between its samples."""
    return any(item.name == name for model in _models() for item in model.inputs)


def process_of(units: Mapping[str, str]) -> ProcessModel | None:
    """The process whose inputs and outputs all are there, by their names and units; None: there is no such one.

    Args:
        units: of the signals that are there, by name.
    """
    return next((model for model in _models() if model.units.items() <= units.items()), None)


@lru_cache(maxsize=256)
def rests(name: str, level: float) -> tuple[SteadyState, ...]:
    """All steady states of a process with one input; the last is the one that it is operated at.

    Args:
        name: of the process.
        level: of its input.
    """
    return tuple(steady_states(_model(name), np.array([level])))


def operating_branch(name: str, lowest: float, highest: float, level: float) -> list[SteadyState]:
    """The steady states between two levels of the input, on the branch that the process is operated on.

    Args:
        name: of a process with one input.
        lowest: level of its input.
        highest: likewise.
        level: the one at which it is operated.

    Returns:
        By rising level, on levels that do not depend on the ends unless these are far apart; as far as the branch goes.
        None if the process knows no such level.
    """
    bounds = _model(name).inputs[0]
    if not bounds.lower <= level <= bounds.upper:
        return []
    lowest, highest = max(lowest, bounds.lower), min(highest, bounds.upper)
    step = 10.0 ** math.floor(math.log10(max(abs(level), 1e-9))) / 40
    while (highest - lowest) / step > MOST_POINTS:
        step *= 2.0
    first, last, start = math.ceil(lowest / step), math.floor(highest / step), round(level / step)
    there = rests(name, start * step)
    if not there:
        return []
    below = _followed(name, there[-1], [number * step for number in range(start - 1, first - 1, -1)])
    above = _followed(name, there[-1], [number * step for number in range(start + 1, last + 1)])
    return [*reversed(below), there[-1], *above]


def _followed(name: str, rest: SteadyState, levels: list[float]) -> list[SteadyState]:
    """The branch that a steady state is on, from level to level until it ends."""
    scale = np.array([state.scale for state in _model(name).states])
    found: list[SteadyState] = []
    for level in levels:
        there = rests(name, level)
        distances = [float(np.linalg.norm((item.state - rest.state) / scale)) for item in there]
        if not there or min(distances) > FARTHEST:
            break
        rest = there[int(np.argmin(distances))]
        found.append(rest)
    return found


def _model(name: str) -> ProcessModel:
    return next(model for model in _models() if model.name == name)


@cache
def _models() -> tuple[ProcessModel, ...]:
    return tuple(build() for build in MODELS)


def _variables() -> list[Variable]:
    return [item for model in _models() for item in (*model.inputs, *model.states)]
