"""Check a sample, convert it to the unit in which its signal is judged, and count those that are rejected. Pure."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import isfinite

import msgspec

from reactorwatch.contract.messages_pb2 import Quality, Sample
from reactorwatch.errors import InputError
from reactorwatch.records.record import LARGEST_VALUE as LARGEST_VALUE
from reactorwatch.stored_state import Memory
from reactorwatch.units import conversion

LARGEST_SAMPLE = 1000
"""Bytes. A sample takes some thirty and its unit; a larger payload is not decoded."""

LARGEST_NUMBER = 2**62
"""Limit of sequence numbers and of times in ns (146 years from 1970): sums of them must still fit into a message."""

USABLE = frozenset({Quality.QUALITY_GOOD, Quality.QUALITY_UNCERTAIN})
"""Qualities of samples that are used."""

LOG_INTERVAL_NS = 60_000_000_000
LONGEST_EXAMPLE = 300
"""Characters. Senders control this text; truncate it."""

MOST_UNITS = 1000
"""Pairs of a signal and a unit whose conversion is kept; publishers choose the texts."""

SAME = (1.0, 0.0)
"""Conversion of a unit to itself, or to another spelling of it."""


def reject_reason(signal: str, sample: Sample) -> tuple[str, str]:
    """Reason to reject a sample, and a description of it."""
    if sample.quality == Quality.QUALITY_UNSPECIFIED:
        return "payload", f"{signal}: the sample has no quality, so it is no Sample of reactorwatch"
    if not isfinite(sample.value):
        return "not_finite", f"{signal} is {sample.value} at {sample.time_ns} ns"
    if sample.quality == Quality.QUALITY_BAD:
        return "bad_quality", f"{signal} is marked bad at {sample.time_ns} ns"
    if sample.quality not in USABLE:
        return "bad_quality", f"{signal} has the quality {sample.quality}, which this version does not know"
    return "out_of_range", f"{signal} is {sample.value} at {sample.time_ns} ns: sizes must be below {LARGEST_VALUE:g}"


class SampleUnits:
    """Converts the samples of a plant; those of signals without a unit here are judged in the units that they come in.

    Args:
        declared: units of the signals as their process describes them.
        model_units: units of the equations.

    Attributes:
        plain: newest unit by signal that needed no conversion.
    """

    def __init__(self, declared: Mapping[str, str], model_units: Mapping[str, str]) -> None:
        self._wanted, self._declared = {**declared, **model_units}, dict(declared)
        self.plain: dict[str, str] = {}
        self._conversions: dict[tuple[str, str], tuple[float, float] | InputError] = {}

    def convert(self, signal: str, unit: str, value: float) -> tuple[float, str]:
        """Value and unit of a sample.

        Args:
            signal: name of the signal.
            unit: unit that the sample names; empty: none.
            value: value in that unit.

        Raises:
            InputError: the unit is unknown, or measures another quantity.
        """
        wanted = self._wanted.get(signal, unit)
        scale, offset = SAME if unit == wanted else self._conversion(signal, unit, wanted)
        if (scale, offset) == SAME:
            self.plain[signal] = unit
            return value, unit
        return scale * value + offset, wanted

    def _conversion(self, signal: str, unit: str, wanted: str) -> tuple[float, float]:
        """Scale and offset of a unit, found once for each signal and unit."""
        known = self._conversions.get((signal, unit))
        if known is None:
            try:
                known = conversion(unit or self._declared.get(signal, wanted), wanted, f"sample of {signal}")
            except InputError as error:
                known = error
            if len(self._conversions) < MOST_UNITS:
                self._conversions[signal, unit] = known
        if isinstance(known, InputError):
            raise known
        return known


class UnusableSamples(Memory, kw_only=True):
    """Samples of a plant's own signals that were refused as samples, since the newest that was used.

    Attributes:
        reasons: text of the reason by signal, for signals whose newest sample was refused.
        in_a_row: number of samples refused since the newest usable one of any signal.
    """

    reasons: dict[str, str] = msgspec.field(default_factory=dict)
    in_a_row: int = 0

    def add(self, signal: str, reason: str) -> None:
        """Count a refused sample."""
        self.reasons[signal] = reason[:LONGEST_EXAMPLE]
        self.in_a_row += 1

    def clear(self, signal: str) -> None:
        """Note a usable sample."""
        self.reasons.pop(signal, None)
        self.in_a_row = 0


@dataclass
class RejectCounter:
    """Counter of rejected messages.

    Attributes:
        by_reason: number of rejected messages by reason since the start.
    """

    by_reason: dict[str, int] = field(default_factory=dict)
    _pending_report: dict[str, str] = field(default_factory=dict)
    _last_report_ns: int | None = None

    def add(self, reason: str, example: str) -> None:
        """Count a message; `example` describes it."""
        self.by_reason[reason] = self.by_reason.get(reason, 0) + 1
        if reason not in self._pending_report:
            is_long = len(example) > LONGEST_EXAMPLE
            self._pending_report[reason] = f"{example[:LONGEST_EXAMPLE]}..." if is_long else example

    @property
    def total(self) -> int:
        """Total over all reasons."""
        return sum(self.by_reason.values())

    def report(self, now_ns: int) -> str | None:
        """One line on messages rejected since the last report; None if there are none, or the report is too recent."""
        if not self._pending_report or (
            self._last_report_ns is not None and now_ns - self._last_report_ns < LOG_INTERVAL_NS
        ):
            return None
        self._last_report_ns = now_ns
        examples = "; ".join(
            f"{reason} ({self.by_reason[reason]} so far): {text}" for reason, text in self._pending_report.items()
        )
        self._pending_report.clear()
        return f"refused messages: {examples}"
