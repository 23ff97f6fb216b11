"""Range: a value that the process cannot have is no measurement.

What the process can have: `monitor_node.learn.signal_range`.
"""

from collections.abc import Sequence
from typing import ClassVar

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.checks.base import Finding, Flags, SignalCheck
from monitor_node.config import MonitorConfig
from monitor_node.learn.signal_range import SignalRange
from reactorwatch.spc.charts.base import Judgement, format_quantity


class RangeCheck(SignalCheck):
    """Compares each input and each output with what the process can have."""

    name, cause = "range", "out_of_range"
    options: ClassVar = {"dead_band": 0.0}

    def __init__(self, config: MonitorConfig, board: Annunciator, ranges: Sequence[SignalRange]) -> None:
        self._bounded = [index for index, item in enumerate(ranges) if item.is_bounded]
        self._invalid: list[bool] = []
        super().__init__(config, board, ranges, [config.signals[index] for index in self._bounded])

    @property
    def invalid(self) -> Flags:
        """See `SignalCheck`."""
        return self._invalid

    def on_row(self, time_ns: int, values: tuple[float, ...]) -> list[Finding]:
        """See `SignalCheck`."""
        self._invalid = []
        findings: list[Finding] = []
        if not any(item.is_bounded for item in self.ranges):
            return findings
        for alarm, index in enumerate(self._bounded):
            value, (lower, upper, unit) = values[index], self.ranges[index]
            if lower <= value <= upper:
                if not self.alarms[alarm].is_idle:
                    findings.append(Finding(alarm, Judgement(value, 0.5 * (lower + upper), lower, upper, False), unit))
            elif value == value:  # NaN is not equal to itself
                self._invalid = self._invalid or [False] * len(values)
                self._invalid[index] = True
                text = (
                    f"{self.signals[alarm]} reads {format_quantity(value, unit, '.6g')}, which the process cannot be: "
                    f"a sensor of it shows {lower:g} to {format_quantity(upper, unit, 'g')}; such values are not used "
                    "as measurements"
                )
                judgement = Judgement(value, 0.5 * (lower + upper), lower, upper, True)
                findings.append(Finding(alarm, judgement, unit, text))
        return findings
