"""Operation of a process: controllers, levels of its inputs, noise of its sensors, named runs, defaults of its watch.

A `Controller` moves one input by one output. It acts once a row, on the output measured in that row, noise included,
and its command is held until the next row:

    input = base + gain (output - set point) + gain / integral time * integral of (output - set point)

A controller that acts in continuous time is part of the equations; it is anything with `extend(model)`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf, isfinite
from typing import Any, TypeAlias

import msgspec

from reactorwatch.process.model import ProcessModel, Variable

SetPoint: TypeAlias = float | tuple[tuple[float, float], ...]
"""One value, or steps as pairs of plant time in min and value, the first at 0."""


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
        # Rounding of a row's time relative to a step.
        return [value for time, value in self.steps if time <= time_min + 1e-9][-1]

    @property
    def is_integral(self) -> bool:
        """True if it has integral action."""
        return isfinite(self.integral_time_min)


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


@dataclass(frozen=True)
class InputLevels:
    """Levels of an input, from which the programmes of a simulated plant take their defaults, in the input's unit.

    Attributes:
        level: level of a constant input, and mean of sinusoids.
        low: lowest level of random steps.
        high: highest level of random steps.
        swing: deviation of a square wave from `level`; the amplitudes of sinusoids are below it.
        hold_min: length of a hold of random steps; the periods of other programmes are multiples of it.
    """

    level: float
    low: float
    high: float
    swing: float
    hold_min: float = 1.0

    @classmethod
    def of(cls, item: Variable, bounds: tuple[float, float]) -> "InputLevels":
        """Levels of an input of which no more is known: a scale about the middle of its bounds."""
        low, high = bounds
        level, swing = 0.5 * (low + high), min(item.scale, 0.25 * (high - low))
        return cls(level, level - swing, level + swing, swing)

    def defaults(self, kind: str) -> dict[str, Any]:
        """Default settings of a kind of programme (see `plant_node.scenario`); empty for a kind without levels."""
        middle = {"low": self.level - self.swing, "high": self.level + self.swing}
        by_kind: dict[str, dict[str, Any]] = {
            "random-steps": {"low": self.low, "high": self.high, "hold_min": self.hold_min},
            "sines": {
                "mean": self.level,
                "amplitudes": tuple(share * self.swing / 5 for share in (4, 3, 2)),
                "periods_min": tuple(period * self.hold_min for period in (3.1, 7.3, 19.7)),
            },
            "square": {**middle, "period_min": 20 * self.hold_min},
            "constant": {"level": self.level},
        }
        return by_kind.get(kind, {})


@dataclass(frozen=True)
class Preset:
    """A named set of settings of the plant.

    Attributes:
        name: name, as in `--preset NAME`.
        meaning: a one-line description.
        settings: settings of `plant_node.config.PlantConfig` by name, as in a settings file.
    """

    name: str
    meaning: str
    settings: Mapping[str, Any]


@dataclass(frozen=True)
class Example:
    """A simulated sample record.

    Attributes:
        meaning: a one-line description.
        faults: specifications of the faults in it, with onsets and ends.
        law: law in it that no cause of the catalogue has; None: there is none.
        with_law: adds that law to the equations; None: there is none.
        rows: number of rows.
        settings: other settings of the plant, as for `Preset`.
    """

    meaning: str
    faults: tuple[str, ...] = ()
    law: str | None = None
    with_law: Callable[[ProcessModel], ProcessModel] | None = None
    rows: int = 2400
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class WatchDefaults:
    """Settings of the watch of a process, and of its identification, where none are stated.

    Attributes:
        training_min: duration of the training in minutes; None: a number of rows.
        smallest_sd: least standard deviation of the residual by output, in its unit.
        priorities: priority of the alarms by output; others have a medium one.
        identified: outputs that are identified; empty: all.
    """

    training_min: float | None = None
    smallest_sd: Mapping[str, float] = field(default_factory=dict)
    priorities: Mapping[str, str] = field(default_factory=dict)
    identified: tuple[str, ...] = ()


@dataclass(frozen=True)
class Operation:
    """Operation of a process in a simulation.

    Attributes:
        inputs: levels of the inputs by name; those of other inputs follow from their bounds and scales.
        noise_sd: standard deviation of the sensors' noise by signal, in the unit of the equations; others have none.
        fault: fault of a demonstration, as `cause:profile:size`; empty: a step of the first effect.
        presets: named runs.
        examples: sample records by name.
        controllers: controllers of its inputs; empty: it is simulated in open loop.
        watch: settings of its watch where none are stated.
    """

    inputs: Mapping[str, InputLevels] = field(default_factory=dict)
    noise_sd: Mapping[str, float] = field(default_factory=dict)
    fault: str = ""
    presets: tuple[Preset, ...] = ()
    examples: Mapping[str, Example] = field(default_factory=dict)
    controllers: tuple[Controller, ...] = ()
    watch: WatchDefaults = field(default_factory=WatchDefaults)
