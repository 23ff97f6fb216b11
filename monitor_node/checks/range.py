"""Range: a value that the process cannot have is no measurement.

What the process can have: `monitor_node.learn.signal_range`.
"""

from collections.abc import Sequence
from typing import ClassVar

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.checks.base import CheckRow, Finding, SignalCheck
from monitor_node.config import MonitorConfig
from monitor_node.learn.signal_range import SignalRange
from reactorwatch.spc.charts.base import Judgement, format_quantity


class RangeCheck(SignalCheck):
    """Compares each input and each output with what the process can have."""

    name, cause, judged = "range", "out_of_range", "signals"
    options: ClassVar = {"dead_band": 0.0}

    def __init__(self, config: MonitorConfig, board: Annunciator, ranges: Sequence[SignalRange]) -> None:
        self._bounded = [index for index, item in enumerate(ranges) if item.is_bounded]
        super().__init__(config, board, ranges, [config.signals[index] for index in self._bounded])

    def update(self, row: CheckRow) -> list[Finding]:
        """See `SignalCheck`."""
        findings, invalid, values = list[Finding](), set[int](), row.values
        for alarm, index in enumerate(self._bounded):
            value, (lower, upper, unit) = values[index], self.ranges[index]
            if value != value:  # NaN is not equal to itself
                continue
            is_out, text = not lower <= value <= upper, ""
            if is_out:
                invalid.add(index)
                text = (
                    f"{self.signals[alarm]} reads {format_quantity(value, unit, '.6g')}, which the process cannot be: "
                    f"a sensor of it shows {lower:g} to {format_quantity(upper, unit, 'g')}; such values are not used "
                    "as measurements"
                )
            elif not self.alarms[alarm].memory.standing:
                continue
            judgement = Judgement(value, 0.5 * (lower + upper), lower, upper, is_out)
            findings.append(Finding(alarm, judgement, unit, text))
        self.invalid = [index in invalid for index in range(len(values))] if invalid else ()
        return findings
