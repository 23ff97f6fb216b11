"""Operation of a process: levels of its inputs, noise of its sensors, named runs, and default settings of its watch."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from reactorwatch.process.controller import Controller
from reactorwatch.process.model import ProcessModel, Variable


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
