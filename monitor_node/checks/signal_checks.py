"""Signal checks of a plant: impossible values, spikes, stuck sensors and data timeouts; their methods are in `spc`.

None of them needs a model of what a fault looks like in the process, and each raises its alarm at once: a stuck sensor
after as many equal readings as its noise makes impossible, a spike with the value after it, a silence when the next
sample is overdue.
"""

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any, ClassVar

import numpy as np

from monitor_node.alarms.alarms import STUCK_SENSOR, AlarmChange
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.checks.base import PLANT, CheckRow, CheckTraining, Finding, Judged, SignalCheck
from monitor_node.config import MonitorConfig
from monitor_node.ingest.intake import UnusableSamples
from monitor_node.watched_process import SignalRange
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Publication
from reactorwatch.spc.charts.base import Judgement, format_quantity
from reactorwatch.spc.false_alarm_budget import TrainingErrors, two_sided_tail
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.silence import Change, DataTimeout, TimeoutMemory
from reactorwatch.spc.spike import Spikes
from reactorwatch.spc.stuck import StuckSensors, quantise
from reactorwatch.stored_state import Records, place_records, read_memory


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


CHECKS: tuple[type[SignalCheck], ...] = (SilenceCheck, StuckCheck, SpikeCheck, RangeCheck)
"""The signal checks. A new one: a file beside this one, and a name here."""


class SignalChecks:
    """Checks the signals of one plant.

    Attributes:
        silence: the check for missing data, which a receive time can decide as well.
    """

    CHANCE_NAMES = tuple(check.name for check in CHECKS if check.can_be_false)
    """Names of an output's alarms that can be false alarms."""

    CHANCE_ALARMS = len(CHANCE_NAMES)
    """Number of them."""

    def __init__(
        self,
        config: MonitorConfig,
        board: Annunciator,
        ranges: Sequence[SignalRange],
        numbers: Records,
    ) -> None:
        self._numbers = numbers
        self._checks = [check(config, board, ranges) for check in CHECKS]
        self.silence = next(check for check in self._checks if isinstance(check, SilenceCheck))
        self._use_numbers()

    def _use_numbers(self) -> None:
        for check in self._checks:
            check.use_numbers(self._numbers[0])

    @property
    def is_ordinary(self) -> bool:
        """True if each check is, see `SignalCheck`."""
        return all(check.is_ordinary for check in self._checks)

    def use_ranges(self, ranges: Sequence[SignalRange]) -> None:
        """Take values beyond these ranges for no measurements from now on."""
        for check in self._checks:
            check.ranges = ranges

    # --- training --------------------------------------------------------------------------------------------

    def start(self, training: CheckTraining) -> None:
        """Learn from the training."""
        for check in self._checks:
            check.start(training)

    def relative_rates(
        self, learned: Sequence[Prewhitening], evaluated: Sequence[bool], arl0: float, errors: TrainingErrors
    ) -> Array:
        """Rate of all false alarms by the errors of the training, in shares of one alarm, shape (draws,)."""
        of_checks = (check.relative_rates(learned, arl0, errors) for check in self._checks if check.can_be_false)
        return sum((rates[:, list(evaluated)].sum(axis=1) for rates in of_checks), np.zeros(len(errors.mean)))

    # --- memory ----------------------------------------------------------------------------------------------

    @property
    def memory(self) -> dict[str, Any]:
        """Memory of each check by name; the alarms belong to the board."""
        return {check.name: check.memory for check in self._checks if check.memory is not None}

    def resume(self, memory: Mapping[str, Any], now_ns: int | None = None) -> None:
        """Resume from the memory of checks with the same settings; the alarms are restored before.

        Args:
            memory: memory of each check, as it was read.
            now_ns: present time, from which the data timeout counts; None: the data timeouts stay as they are.

        Raises:
            ValueError: the memory is damaged, or of other checks.
        """
        checks = {check.name: check for check in self._checks if check.memory is not None}
        if checks.keys() != memory.keys():
            raise ValueError(f"the state must be of the checks {sorted(checks)}, got {sorted(memory)}")
        for name, check in checks.items():
            if now_ns is not None or check is not self.silence:
                check.memory = read_memory(memory[name], type(check.memory))
        self._use_numbers()
        if now_ns is not None:
            self.silence.of_plant.arm(now_ns)

    # --- rows ------------------------------------------------------------------------------------------------

    def update(self, judged: Judged, row: CheckRow, changes: list[AlarmChange]) -> list[bool]:
        """Check a row by each check of these values; returns a flag for each that is no measurement."""
        flags = [False] * len(row.values)
        for check in self._checks:
            if check.judged != judged:
                continue
            if findings := check.update(row):
                changes += check.changes(findings)
            invalid = check.invalid
            if check.is_invalid_while_active:
                invalid = [alarm.memory.standing for alarm in check.alarms]
            for i, is_invalid in enumerate(invalid):
                flags[i] = flags[i] or is_invalid
        return flags

    def on_gap(self) -> None:
        """Forget what is quarantined, as after a gap."""
        for check in self._checks:
            check.on_gap()

    def on_restart(self) -> None:
        """Drop earlier rows: the publisher was restarted."""
        for check in self._checks:
            check.on_restart()
