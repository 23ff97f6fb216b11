"""Stuck: a sensor that gives the same reading too often in a row; the method is `spc.stuck`."""

from collections.abc import Sequence
from math import isfinite

import numpy as np

from monitor_node.alarms.alarms import STUCK_SENSOR
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.checks.base import CheckRow, CheckTraining, Finding, SignalCheck
from monitor_node.config import MonitorConfig
from monitor_node.learn.signal_range import SignalRange
from reactorwatch.spc.charts.base import format_quantity
from reactorwatch.spc.stuck import StuckSensors, quantise


class StuckCheck(SignalCheck):
    """Raises an alarm when the sensor of an output is stuck; its readings are no measurements then."""

    name, cause = "stuck", STUCK_SENSOR
    can_be_false = is_invalid_while_active = True
    memory: StuckSensors

    def __init__(self, config: MonitorConfig, board: Annunciator, ranges: Sequence[SignalRange]) -> None:
        super().__init__(config, board, ranges)
        self._resolutions = np.array([config.resolution.get(name, 0.0) for name in self.outputs])
        self.memory = StuckSensors.of(len(self.outputs))

    def use_numbers(self, numbers: np.void) -> None:
        """See `SignalCheck`."""
        self.memory.place(numbers["stuck"])

    @property
    def is_ordinary(self) -> bool:
        """See `SignalCheck`."""
        return self.memory.is_ready

    def start(self, training: CheckTraining) -> None:
        """See `SignalCheck`."""
        for i, (readings, step) in enumerate(zip(training.values, self._resolutions.tolist(), strict=True)):
            given = np.array(readings)
            given = given[np.isfinite(given)]
            exact = np.array([quantise(reading, step) for reading in given.tolist()]) if step else given
            self.memory.learn(i, exact, training.arl0)

    def update(self, row: CheckRow) -> list[Finding]:
        """See `SignalCheck`."""
        is_active = any(alarm.memory.standing for alarm in self.alarms)
        if not (self.memory.update(np.array(row.values), self._resolutions) or is_active):
            return []
        readings = enumerate(zip(row.values, row.units, strict=True))
        return [self._find(i, format_quantity(value, unit, ".6g")) for i, (value, unit) in readings if isfinite(value)]

    def _find(self, i: int, reading: str) -> Finding:
        judgement = self.memory.judge(i)
        text = f"{self.outputs[i]} is stuck: it has read {reading} {judgement.statistic:.0f} times in a row"
        return Finding(i, judgement, "readings", text)

    def on_restart(self) -> None:
        """See `SignalCheck`. After a gap equal readings are counted on: it makes them no likelier."""
        self.memory.restart()
