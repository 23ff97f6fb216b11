"""Range: a value that the process cannot have is no measurement.

What the process can have: `monitor_node.baseline.signal_range`.
"""

from collections.abc import Sequence
from math import nan

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.signal_range import SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.signal_checks.base import SignalCheck
from reactorwatch.contract.codec import Publication
from reactorwatch.spc.charts.base import Judgement

OUT_OF_RANGE = "out_of_range"
"""The suspect of the alarm."""


class RangeCheck(SignalCheck):
    """Compares each input and each output with what the process can have."""

    name = "range"

    def __init__(self, config: MonitorConfig, board: Annunciator, ranges: Sequence[SignalRange]) -> None:
        super().__init__(config, board, ranges)
        self.ranges, self._names = ranges, config.signals
        self._alarms = [
            board.declare(self.name, signal, without_on_delay=True, dead_band=0.0, names_cause=True)
            if item.is_bounded
            else None
            for signal, item in zip(self._names, ranges, strict=True)
        ]

    def measured_values(
        self, time_ns: int, values: tuple[float, ...], publications: list[Publication]
    ) -> tuple[float, ...]:
        """See `SignalCheck`."""
        for index, (value, alarm) in enumerate(zip(values, self._alarms, strict=True)):
            if alarm is None or value != value:
                continue
            lower, upper, unit = self.ranges[index]
            out, rule = not lower <= value <= upper, alarm.memory.rule
            if not (out or rule.standing or rule.recent):
                continue
            name = self._names[index]
            text = (
                f"{name} reads {value:.6g} {unit}, which the process cannot be: a sensor of it shows {lower:g} to "
                f"{upper:g} {unit}; such values are not used as measurements"
            )
            judgement = Judgement(value, 0.5 * (lower + upper), lower, upper, out)
            publications += self.judge(alarm, time_ns, judgement, unit, text, name, cause=OUT_OF_RANGE)
            if out:
                values = (*values[:index], nan, *values[index + 1 :])
        return values
