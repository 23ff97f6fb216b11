"""Scenarios: the commanded coolant flow as a function of time.

A scenario is a frozen structure of settings, and its level depends on nothing but time and seed. So a run can be cut
anywhere, sped up or started in the middle, and its input is the same. Random levels are numbered for this: every hold
of `RandomSteps` has a generator of its own, seeded with (seed, stream, index of the hold).

The default levels keep the nominal plant on its operating branch; a large or fast enough change of the coolant flow
extinguishes it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import isfinite, pi, sin
from typing import Any, ClassVar, Protocol, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.records.record import Record

SIGNAL = "qc"

_STREAM = int.from_bytes(b"scenario")
_EDGE = 1e-6  # in holds: rounding of a sample's time relative to an edge


class Scenario(Protocol):
    """A coolant flow over time."""

    @property
    def mean(self) -> float:
        """Mean level in l/min."""

    def level(self, time_min: float, seed: int) -> float:
        """Commanded coolant flow in l/min at a plant time, a deterministic function of the arguments."""


class RandomSteps(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A new level, uniformly distributed, at regular times.

    Attributes:
        low: lowest level, l/min.
        high: highest level, l/min.
        hold_min: length of a hold.
    """

    kind: ClassVar[str] = "random-steps"
    low: float = 90.0
    high: float = 111.0
    hold_min: float = 1.0

    def __post_init__(self) -> None:
        _check_levels(low=self.low, high=self.high)
        _check_order(self.low, self.high)
        _check_positive("hold_min", self.hold_min)

    @property
    def mean(self) -> float:
        """See `Scenario`."""
        return 0.5 * (self.low + self.high)

    def level(self, time_min: float, seed: int) -> float:
        """See `Scenario`."""
        return self.low + (self.high - self.low) * _uniform(seed, int(time_min / self.hold_min + _EDGE))


class Sines(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sum of sinusoids about a mean.

    Attributes:
        mean: mean level, l/min.
        amplitudes: amplitude of each sinusoid, l/min.
        periods_min: period of each sinusoid. The defaults have no common multiple within hours.
        phases: phase of each sinusoid at plant time 0, in rad; default: zero.
    """

    kind: ClassVar[str] = "sines"
    mean: float = 100.0
    amplitudes: tuple[float, ...] = (4.0, 3.0, 2.0)
    periods_min: tuple[float, ...] = (3.1, 7.3, 19.7)
    phases: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if not self.amplitudes:
            raise ValueError("amplitudes must hold at least one number; for none there is 'constant'")
        for name, values in (("periods_min", self.periods_min), ("phases", self.phases or self.amplitudes)):
            if len(values) != len(self.amplitudes):
                raise ValueError(f"{name} must be as many as amplitudes, {len(self.amplitudes)}, got {len(values)}")
        swing = sum(abs(amplitude) for amplitude in self.amplitudes)
        _check_levels(**{"mean - amplitudes": self.mean - swing, "mean + amplitudes": self.mean + swing})
        for period in self.periods_min:
            _check_positive("periods_min", period)

    def level(self, time_min: float, seed: int) -> float:
        """See `Scenario`."""
        phases = self.phases or (0.0,) * len(self.amplitudes)
        return self.mean + sum(
            amplitude * sin(2 * pi * time_min / period + phase)
            for amplitude, period, phase in zip(self.amplitudes, self.periods_min, phases, strict=True)
        )


class Square(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Half a period low, half a period high.

    Attributes:
        low: low level, l/min.
        high: high level, l/min.
        period_min: period.
    """

    kind: ClassVar[str] = "square"
    low: float = 95.0
    high: float = 105.0
    period_min: float = 20.0

    def __post_init__(self) -> None:
        _check_levels(low=self.low, high=self.high)
        _check_order(self.low, self.high)
        _check_positive("period_min", self.period_min)

    @property
    def mean(self) -> float:
        """See `Scenario`."""
        return 0.5 * (self.low + self.high)

    def level(self, time_min: float, seed: int) -> float:
        """See `Scenario`."""
        return self.high if int(2 * time_min / self.period_min + _EDGE) % 2 else self.low


class Constant(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A constant level.

    Attributes:
        level_l_min: the level, l/min.
    """

    kind: ClassVar[str] = "constant"
    level_l_min: float = 100.0

    def __post_init__(self) -> None:
        _check_levels(level_l_min=self.level_l_min)

    @property
    def mean(self) -> float:
        """See `Scenario`."""
        return self.level_l_min

    def level(self, time_min: float, seed: int) -> float:
        """See `Scenario`."""
        return self.level_l_min


class FromFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The coolant flow of a measured record, read into a `HeldRecord`.

    Attributes:
        path: path of the record, a .csv file.
    """

    kind: ClassVar[str] = "file"
    path: str


@dataclass(frozen=True, eq=False)
class HeldRecord:
    """The coolant flow of a record with zero-order hold; the first row is plant time 0, the last is held.

    Attributes:
        time_min: times from 0, shape (rows,).
        levels: levels in l/min, shape (rows,).
    """

    time_min: NDArray[np.float64]
    levels: NDArray[np.float64]

    @classmethod
    def of(cls, record: Record) -> "HeldRecord":
        """Take the coolant flow from a record.

        Raises:
            InputError: it has no coolant flow, or one with gaps.
        """
        if SIGNAL not in record.columns or not record.rows:
            raise InputError(f"{record.name}: must have a column {SIGNAL!r} with at least one row to drive the plant")
        if record.runs is not None:
            raise InputError(
                f"{record.name}: must be one run to drive the plant, {record.describe_runs()}; cut one run out of it"
            )
        levels = record.columns[SIGNAL]
        bad = ~(np.isfinite(levels) & (levels >= 0))
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(
                f"{record.name}: {SIGNAL} must be a number of at least 0 l/min in every row to drive the plant, "
                f"got {levels[row]:g} at {record.time_min[row]:g} min"
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

SCENARIOS: tuple[type[Settings], ...] = (RandomSteps, Sines, Square, Constant, FromFile)


def scenario_settings(setting: str | Mapping[str, Any]) -> Settings:
    """Parse the scenario of a setting.

    Args:
        setting: a kind, for its defaults; the path of a .csv record; or a table with `kind` and its parameters.

    Raises:
        InputError: an unknown kind or key, or a value that breaks a rule.
    """
    if isinstance(setting, str):
        setting = {"kind": FromFile.kind, "path": setting} if setting.lower().endswith(".csv") else {"kind": setting}
    kinds = {item.kind: item for item in SCENARIOS}
    if "kind" not in setting:
        raise InputError(f"scenario must have a 'kind' (valid: {', '.join(kinds)}), got {dict(setting)}")
    kind, values = setting["kind"], {key: value for key, value in setting.items() if key != "kind"}
    if kind not in kinds:
        raise InputError(f"scenario: {describe_unknown('kind', str(kind), kinds)}")
    fields = tuple(field.name for field in msgspec.structs.fields(kinds[kind]))
    for key in values:
        if key not in fields:
            raise InputError(f"scenario {kind}: {describe_unknown('key', key, fields)}")
    if kind == FromFile.kind and "path" not in values:
        raise InputError("scenario file: 'path' must say which .csv record drives the plant")
    try:
        settings: Settings = msgspec.convert(values, kinds[kind])
    except msgspec.ValidationError as error:
        raise InputError(f"scenario {kind}: {error}") from error
    return settings


@lru_cache(maxsize=1024)
def _uniform(seed: int, index: int) -> float:
    """Draw a uniform number in [0, 1), a deterministic function of the arguments."""
    return float(np.random.default_rng(np.random.SeedSequence([seed, _STREAM, index])).random())


def _check_levels(**levels: float) -> None:
    for name, level in levels.items():
        if not (isfinite(level) and level >= 0):
            raise ValueError(f"{name} must be at least 0 l/min, got {level:g}")


def _check_order(low: float, high: float) -> None:
    if not low <= high:
        raise ValueError(f"low must not exceed high, got {low:g} and {high:g} l/min")


def _check_positive(name: str, value: float) -> None:
    if not (isfinite(value) and value > 0):
        raise ValueError(f"{name} must be above 0 min, got {value:g}")
