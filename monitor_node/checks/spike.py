"""Spike: one outlier of an output, followed by an ordinary value; the method is `spc.spike`."""

from collections.abc import Sequence
from math import isfinite
from typing import ClassVar

import numpy as np

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.checks.base import CheckRow, CheckTraining, Finding, SignalCheck
from monitor_node.config import MonitorConfig
from monitor_node.learn.signal_range import SignalRange
from reactorwatch.arrays import Array
from reactorwatch.spc.charts.base import Judgement, format_quantity
from reactorwatch.spc.false_alarm_budget import TrainingErrors, two_sided_tail
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.spike import Spikes


class SpikeCheck(SignalCheck):
    """Raises an alarm when an output had a spike, and quarantines what may be one."""

    name, cause, judged = "spike", "spike", "residuals"
    options: ClassVar = {"priority": "low", "is_transient": True}
    can_be_false = True
    memory: Spikes

    def __init__(self, config: MonitorConfig, board: Annunciator, ranges: Sequence[SignalRange]) -> None:
        super().__init__(config, board, ranges)
        self.memory = Spikes()
        self._limits: Array = np.full(len(self.outputs), np.inf)

    def use_numbers(self, numbers: np.void) -> None:
        """See `SignalCheck`: the limit of each output, within which a residual is no spike."""
        self._limits = numbers["spike_limits"]
        self._set_limits()

    def start(self, training: CheckTraining) -> None:
        """See `SignalCheck`."""
        self.memory.learn(training.e, training.outliers, training.period_ns, training.arl0)
        self._set_limits()

    def _set_limits(self) -> None:
        if self.memory.of_outputs:
            self._limits[:] = [np.inf if spike is None else spike.limit for spike in self.memory.of_outputs]

    def relative_rates(self, learned: Sequence[Prewhitening], arl0: float, errors: TrainingErrors) -> Array:
        """See `SignalCheck`."""
        scales = np.column_stack([errors.true_scale(i, item, 1.0) for i, item in enumerate(learned)])
        shifts = scales * errors.mean / np.sqrt([float(item.rows) for item in learned])
        return np.column_stack(
            [arl0 * two_sided_tail(limit, shifts[:, i], scales[:, i]) for i, limit in enumerate(self._limits.tolist())]
        )

    @property
    def is_ordinary(self) -> bool:
        """See `SignalCheck`."""
        return self.memory.is_ordinary

    def update(self, row: CheckRow) -> list[Finding]:
        """See `SignalCheck`."""
        findings: list[Finding] = []
        verdicts = self.memory.update(row.values, is_moved=self.board.has_unexplained)
        self.invalid = [verdict.quarantine for verdict in verdicts]
        for i, (verdict, spike, alarm) in enumerate(zip(verdicts, self.memory.of_outputs, self.alarms, strict=False)):
            if spike is None or not isfinite(row.values[i]) or not (verdict.spike or alarm.memory.standing):
                continue
            usual, size, text = spike.usual, 0.0, ""
            count = 1 if usual is None or not verdict.spike else usual.add(row.time_ns)
            is_out = verdict.spike and count > 0
            if is_out:
                size = verdict.size
                spiked = format_quantity(size * row.scales[i], row.units[i], "+.3g")
                text = f"{self.outputs[i]} had a spike of {spiked} one row before; it was left out"
                if usual is not None:
                    text += f"; {count} spikes in {usual.window_min:.3g} min, where {usual.usual:.2g} are usual"
            findings.append(Finding(i, Judgement(size, 0.0, -spike.limit, spike.limit, is_out), "sd", text))
        return findings

    def on_gap(self) -> None:
        """See `SignalCheck`."""
        self.memory.restart()
