"""Silence: a plant, or one of its signals, has stopped sending; the method is `spc.silence`."""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.checks.base import PLANT, CheckRow, Finding, SignalCheck
from monitor_node.config import MonitorConfig
from monitor_node.ingest.samples import UnusableSamples
from monitor_node.learn.signal_range import SignalRange
from reactorwatch.contract.codec import Publication
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.silence import Change, DataTimeout, TimeoutMemory
from reactorwatch.stored_state import place_records

UNUSABLE = 32
"""Samples in a row that cannot be used before a plant without usual spacing has a timeout: as many as it is learned
from."""

SILENT, RECEIVED = Judgement(1.0, 0.0, 0.0, 0.0, True), Judgement(0.0, 0.0, 0.0, 0.0, False)


class SilenceCheck(SignalCheck):
    """Raises an alarm when the plant, or one of its signals, is silent, or sends nothing that can be used.

    Attributes:
        of_plant: timeouts of the plant and of its signals.
        unusable: samples of the plant that were refused since the newest usable one; the monitor counts them.
    """

    name, cause, judged = "silence", "silence", "signals"
    options: ClassVar = {"without_off_delay": True, "priority": "high"}

    def __init__(self, config: MonitorConfig, board: Annunciator, ranges: Sequence[SignalRange]) -> None:
        super().__init__(config, board, ranges, (PLANT, *config.signals))
        self.unusable = UnusableSamples()
        self.of_plant = DataTimeout(len(config.signals), config.silence_periods)

    @property
    def memory(self) -> TimeoutMemory:
        """See `SignalCheck`."""
        return self.of_plant.memory

    @memory.setter
    def memory(self, memory: TimeoutMemory) -> None:
        self.of_plant.memory = memory

    def use_numbers(self, numbers: np.void) -> None:
        """See `SignalCheck`."""
        self.memory.numbers = place_records(self.memory.numbers, numbers["timeouts"])

    @property
    def silent(self) -> list[bool]:
        """Flags of the signals without data, the inputs first."""
        return [is_active == 1 for is_active in self.memory.numbers["is_active"][1:].tolist()]

    @property
    def is_ordinary(self) -> bool:
        """See `SignalCheck`: the newest row has all signals, and no timeout is active."""
        times_ns = self.memory.numbers["last_ns"]
        return not self.memory.numbers["is_active"].any() and bool((times_ns == times_ns[0]).all())

    def follow_alarms(self) -> None:
        """Take as silent what the alarms say is silent: the next sample ends it."""
        self.memory.numbers["is_active"] = [alarm.memory.standing for alarm in self.alarms]

    def update(self, row: CheckRow) -> list[Finding]:
        """See `SignalCheck`."""
        return [
            finding
            for i, change in self.of_plant.update(row.time_ns, row.values)
            for finding in self._findings(i, change)
        ]

    def postpone(self, now_ns: int) -> None:
        """Restart an expired timer of the plant: a monitor with messages to process cannot say what has not come."""
        due_ns = self.of_plant.due_ns()
        if due_ns is not None and now_ns >= due_ns:
            self.of_plant.arm(now_ns)

    @property
    def is_unusable(self) -> bool:
        """True if samples come and none was usable, of a plant whose usual spacing is therefore unknown."""
        plant = self.of_plant
        return self.unusable.in_a_row >= UNUSABLE and plant.deadline_ns() is None and not plant.is_active

    def check(self, now_ns: int) -> list[Publication]:
        """Check the plant's timeout in receive time."""
        if self.is_unusable:
            return self.declare_unusable(now_ns)
        return self._publish(now_ns, self.of_plant.check(now_ns))

    def declare_unusable(self, time_ns: int) -> list[Publication]:
        """Declare a timeout of a plant without a usable sample, at a receive time."""
        self.memory.numbers["is_active"][0] = True
        return self._publish(time_ns, Change(time_ns, None))

    def declare_timeout(self, time_ns: int) -> list[Publication]:
        """Declare a timeout of the plant that was recorded, where the receive time expired it."""
        return self._publish(time_ns, self.of_plant.declare_timeout())

    def _publish(self, time_ns: int, change: Change) -> list[Publication]:
        """Publications of a change of the plant's timeout outside of a row."""
        return self.board.apply(time_ns, self.changes(self._findings(0, change)))

    def _findings(self, index: int, change: Change) -> list[Finding]:
        """The timeout of the plant (index 0) or of a signal, if it changes."""
        findings: list[Finding] = []
        if change.raised_ns is not None:
            findings.append(Finding(index, SILENT, text=self._text(index), time_ns=change.raised_ns))
        if change.cleared_ns is not None:
            findings.append(Finding(index, RECEIVED, time_ns=change.cleared_ns))
        return findings

    def _text(self, index: int) -> str:
        name, reasons = self.signals[index], self.unusable.reasons
        if index == 0 and self.unusable.in_a_row:
            return f"no usable sample of the plant comes: {'; '.join(reasons.values())}"
        if name in reasons:
            return f"no usable sample of {name} comes: {reasons[name]}"
        return "the plant is silent: no sample of it comes" if index == 0 else f"{name} is silent: the others go on"
