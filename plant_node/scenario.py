"""Scenarios: the command of an input as a function of time.

A scenario is a frozen structure of settings, and its level depends on nothing but time and seed. So a run can be cut
anywhere, sped up or started in the middle, and its input is the same. Random levels are numbered for this: every hold
of `RandomSteps` has a generator of its own, seeded with (seed, stream, index of the hold).

The default levels keep the nominal plant on its operating branch; a large or fast enough change of the coolant flow
extinguishes it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import isfinite, pi, sin
from typing import Any, ClassVar, Protocol, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError, describe_unknown, prefix_errors
from reactorwatch.process.model import Variable
from reactorwatch.process.operation import InputLevels
from reactorwatch.records.record import Record

OLD_KEYS = {"level_l_min": "level"}
"""Keys of earlier versions, by which settings may still name a parameter."""

_STREAM = int.from_bytes(b"scenario")
_EDGE = 1e-6  # in holds: rounding of a sample's time relative to an edge


class Scenario(Protocol):
    """The command of an input over time, in its unit."""

    @property
    def mean(self) -> float:
        """Mean level."""

    def level(self, time_min: float, seed: int) -> float:
        """Command at a plant time, a deterministic function of the arguments."""


class _Between(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A scenario between a lowest and a highest level, with their middle as its mean."""

    low: float
    high: float

    def __post_init__(self) -> None:
        if not self.low <= self.high:
            raise ValueError(f"low must not exceed high, got {self.low:g} and {self.high:g}")

    @property
    def mean(self) -> float:
        """See `Scenario`."""
        return 0.5 * (self.low + self.high)


class RandomSteps(_Between, frozen=True, forbid_unknown_fields=True):
    """A new level, uniformly distributed, at regular times.

    Attributes:
        low: lowest level.
        high: highest level.
        hold_min: length of a hold.
    """

    kind: ClassVar[str] = "random-steps"
    hold_min: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_positive("hold_min", self.hold_min)

    def level(self, time_min: float, seed: int) -> float:
        """See `Scenario`."""
        return self.low + (self.high - self.low) * _uniform(seed, int(time_min / self.hold_min + _EDGE))


class Sines(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sum of sinusoids about a mean.

    Attributes:
        mean: mean level.
        amplitudes: amplitude of each sinusoid.
        periods_min: period of each sinusoid. The defaults have no common multiple within hours.
        phases: phase of each sinusoid at plant time 0, in rad; default: zero.
    """

    kind: ClassVar[str] = "sines"
    mean: float
    amplitudes: tuple[float, ...]
    periods_min: tuple[float, ...]
    phases: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.amplitudes:
            raise ValueError("amplitudes must hold at least one number; for none there is 'constant'")
        for name, values in (("periods_min", self.periods_min), ("phases", self.phases or self.amplitudes)):
            if len(values) != len(self.amplitudes):
                raise ValueError(f"{name} must be as many as amplitudes, {len(self.amplitudes)}, got {len(values)}")
        for period in self.periods_min:
            _check_positive("periods_min", period)

    def level(self, time_min: float, seed: int) -> float:
        """See `Scenario`."""
        phases = self.phases or (0.0,) * len(self.amplitudes)
        return self.mean + sum(
            amplitude * sin(2 * pi * time_min / period + phase)
            for amplitude, period, phase in zip(self.amplitudes, self.periods_min, phases, strict=True)
        )


class Square(_Between, frozen=True, forbid_unknown_fields=True):
    """Half a period low, half a period high.

    Attributes:
        low: low level.
        high: high level.
        period_min: period.
    """

    kind: ClassVar[str] = "square"
    period_min: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_positive("period_min", self.period_min)

    def level(self, time_min: float, seed: int) -> float:
        """See `Scenario`."""
        return self.high if int(2 * time_min / self.period_min + _EDGE) % 2 else self.low


class Constant(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A constant level.

    Attributes:
        value: the level.
    """

    kind: ClassVar[str] = "constant"
    value: float = msgspec.field(name="level")

    @property
    def mean(self) -> float:
        """See `Scenario`."""
        return self.value

    def level(self, time_min: float, seed: int) -> float:
        """See `Scenario`."""
        return self.value


class FromFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The input of a measured record, read into a `HeldRecord`.

    Attributes:
        path: path of the record, in any format that is read.
    """

    kind: ClassVar[str] = "file"
    path: str


@dataclass(frozen=True, eq=False)
class HeldRecord:
    """An input of a record with zero-order hold; the first row is plant time 0, the last is held.

    Attributes:
        time_min: times from 0, shape (rows,).
        levels: levels, shape (rows,).
    """

    time_min: NDArray[np.float64]
    levels: NDArray[np.float64]

    @classmethod
    def of(cls, record: Record, item: Variable) -> "HeldRecord":
        """Take an input from a record."""
        name = item.name
        if name not in record.columns or not record.rows:
            raise InputError(f"{record.name}: must have a column {name!r} with at least one row to drive the plant")
        if record.runs is not None:
            raise InputError(
                f"{record.name}: must be one run to drive the plant, {record.describe_runs()}; cut one run out of it"
            )
        levels = record.columns[name]
        bad = ~(np.isfinite(levels) & (levels >= item.lower))
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(
                f"{record.name}: {name} must be a number of at least {item.lower:g} {item.unit} in every row to drive "
                f"the plant, got {levels[row]:g} at {record.time_min[row]:g} min"
            )
        return cls(record.time_min - record.time_min[0], levels)

    @property
    def mean(self) -> float:
        """See `Scenario`; the mean over rows."""
        return float(np.mean(self.levels))

    def level(self, time_min: float, seed: int) -> float:
        """See `Scenario`."""
        row = int(np.searchsorted(self.time_min, time_min + _EDGE * 1e-3, side="right")) - 1
        return float(self.levels[max(row, 0)])


Settings: TypeAlias = RandomSteps | Sines | Square | Constant | FromFile

KINDS: dict[str, type[Settings]] = {item.kind: item for item in (RandomSteps, Sines, Square, Constant, FromFile)}


def split_scenarios(setting: str | Mapping[str, Any], inputs: Sequence[str]) -> dict[str, str | Mapping[str, Any]]:
    """Scenario of each input: one for all, as text, or a table by input; without an entry, random steps."""
    if isinstance(setting, str):
        return dict.fromkeys(inputs, setting)
    if len(inputs) == 1 and not set(setting) <= set(inputs):
        return {inputs[0]: setting}
    if "kind" in setting:
        raise InputError(f"scenario must be a table for each input, like [plant.scenario.{inputs[0]}], got {setting}")
    for name in setting:
        if name not in inputs:
            raise InputError(f"scenario: {describe_unknown('input', name, inputs)}")
    return {name: setting.get(name, RandomSteps.kind) for name in inputs}


def scenario_settings(setting: str | Mapping[str, Any], levels: InputLevels) -> Settings:
    """Parse the scenario of an input: a kind, the path of a record, or a table with `kind` and its parameters."""
    if isinstance(setting, str):
        is_file = "." in setting and setting not in KINDS
        setting = {"kind": FromFile.kind, "path": setting} if is_file else {"kind": setting}
    if "kind" not in setting:
        raise InputError(f"scenario must have a 'kind' (valid: {', '.join(KINDS)}), got {dict(setting)}")
    kind = setting["kind"]
    values = {OLD_KEYS.get(key, key): value for key, value in setting.items() if key != "kind"}
    if kind not in KINDS:
        raise InputError(f"scenario: {describe_unknown('kind', str(kind), KINDS)}")
    fields = tuple(field.encode_name for field in msgspec.structs.fields(KINDS[kind]))
    for key in values:
        if key not in fields:
            raise InputError(f"scenario {kind}: {describe_unknown('key', key, fields)}")
    if kind == FromFile.kind and "path" not in values:
        raise InputError("scenario file: 'path' must say which record drives the plant")
    with prefix_errors(f"scenario {kind}", ValueError):
        return msgspec.convert({**levels.defaults(kind), **values}, KINDS[kind])


def check_levels(settings: Settings, item: Variable) -> None:
    """Check that the levels of a scenario are within the bounds of its input; those of a record are checked later."""
    extremes: dict[str, float] = {}
    match settings:
        case RandomSteps() | Square():
            extremes = {"low": settings.low, "high": settings.high}
        case Sines():
            swing = sum(abs(amplitude) for amplitude in settings.amplitudes)
            extremes = {"mean - amplitudes": settings.mean - swing, "mean + amplitudes": settings.mean + swing}
        case Constant():
            extremes = {"level": settings.value}
    for name, level in extremes.items():
        if not item.lower <= level <= item.upper:
            raise InputError(
                f"scenario {settings.kind}: {name} must be in [{item.lower:g}, {item.upper:g}] {item.unit}, "
                f"got {level:g}"
            )


def seed_of_input(seed: int, index: int) -> int:
    """Seed of the scenario of an input, by its index; that of the first is the seed of the plant."""
    return seed if index == 0 else int(np.random.SeedSequence([seed, index]).generate_state(1, np.uint64)[0] >> 1)


@lru_cache(maxsize=1024)
def _uniform(seed: int, index: int) -> float:
    """Draw a uniform number in [0, 1), a deterministic function of the arguments."""
    return float(np.random.default_rng(np.random.SeedSequence([seed, _STREAM, index])).random())


def _check_positive(name: str, value: float) -> None:
    if not (isfinite(value) and value > 0):
        raise ValueError(f"{name} must be above 0 min, got {value:g}")
