"""Controllers of a process in a simulation.

A `Controller` moves one input by one output. It acts once a row, on the output measured in that row, noise included,
and its command is held until the next row:

    input = base + gain (output - set point) + gain / integral time * integral of (output - set point)

A controller that acts in continuous time is part of the equations; it is anything with `extend(model)`.
"""

from itertools import pairwise
from math import inf, isfinite
from typing import Protocol, TypeAlias, runtime_checkable

import msgspec

from reactorwatch.process.model import ProcessModel

SetPoint: TypeAlias = float | tuple[tuple[float, float], ...]
"""One value, or steps as pairs of plant time in min and value, the first at 0."""

_EDGE_MIN = 1e-9  # rounding of a row's time relative to a step


class Controller(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A proportional-integral controller of an output by an input.

    Attributes:
        input: name of the input that it moves.
        output: name of the output that it holds.
        set_point: see `SetPoint`, in the output's unit.
        gain: change of the input over that of the output; positive where a larger output needs a larger input.
        base: input at the set point.
        integral_time_min: integral time; inf: no integral action, so that an offset from the set point remains.
        dither: whether the deviation of the input's programme from its mean is added to the command. Identification in
            closed loop needs it: feedback alone is a function of the output and carries no information about the plant.
    """

    input: str
    output: str
    set_point: SetPoint
    gain: float
    base: float
    integral_time_min: float = inf
    dither: bool = False

    def __post_init__(self) -> None:
        if not (isfinite(self.gain) and self.gain != 0):
            raise ValueError(f"gain must be a number other than 0, got {self.gain:g}")
        if not isfinite(self.base):
            raise ValueError(f"base must be a finite number, got {self.base:g}")
        if not self.integral_time_min > 0:
            raise ValueError(f"integral_time_min must be above 0, got {self.integral_time_min:g}")
        check_steps("set_point", self.set_point)

    @property
    def steps(self) -> tuple[tuple[float, float], ...]:
        """The set point as pairs of plant time in min and value."""
        return steps_of(self.set_point)

    def set_point_at(self, time_min: float) -> float:
        """The set point at a plant time of at least 0."""
        return [value for time, value in self.steps if time <= time_min + _EDGE_MIN][-1]

    @property
    def is_integral(self) -> bool:
        """True if it has integral action."""
        return isfinite(self.integral_time_min)


@runtime_checkable
class ContinuousController(Protocol):
    """A controller that is part of the equations."""

    def extend(self, model: ProcessModel) -> ProcessModel:
        """Model with the controller in it.

        Raises:
            ValueError: the model lacks what it acts on.
        """


def steps_of(set_point: SetPoint) -> tuple[tuple[float, float], ...]:
    """A set point as pairs of plant time in min and value."""
    return set_point if isinstance(set_point, tuple) else ((0.0, set_point),)


def check_steps(name: str, set_point: SetPoint) -> None:
    """Check that the steps of a set point rise in time and are numbers.

    Raises:
        ValueError: they do not.
    """
    steps = steps_of(set_point)
    times = [time for time, _ in steps]
    if not times or times[0] != 0 or any(not one < other for one, other in pairwise(times)):
        given = ", ".join(f"{time:g}" for time in times) or "none"
        raise ValueError(f"{name} must have steps at rising times in min, the first at 0, got {given}")
    for _, value in steps:
        if not isfinite(value):
            raise ValueError(f"{name} must be a finite number, got {value:g}")
