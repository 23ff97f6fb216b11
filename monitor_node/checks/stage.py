"""The checks of the signals of a plant, `CHECKS`, together.

None of them needs a model of what a fault looks like in the process, and each raises its alarm at once: a stuck sensor
after as many equal readings as its noise makes impossible, a spike with the value after it, a silence when the next
sample is overdue.
"""

from collections.abc import Mapping, Sequence
from math import nan
from typing import Any

import numpy as np

from monitor_node.alarms.alarms import AlarmChange, SuspectedCause
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.checks.base import PLANT, CheckTraining, Finding, Flags, SignalCheck
from monitor_node.checks.range import RangeCheck
from monitor_node.checks.silence import SilenceCheck
from monitor_node.checks.spike import SpikeCheck
from monitor_node.checks.stuck import StuckCheck
from monitor_node.config import MonitorConfig
from monitor_node.learn.signal_range import SignalRange
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Publication
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.training_errors import TrainingErrors
from reactorwatch.stored_state import Records, read_memory

CHECKS: tuple[type[SignalCheck], ...] = (SilenceCheck, StuckCheck, SpikeCheck, RangeCheck)
"""The signal checks. A new one: a file beside this one, and a name here."""

SENSOR = "sensor"
"""Kind of the causes that checks suspect."""


class SignalChecks:
    """Checks the signals of one plant.

    Args:
        config: configuration of the monitor.
        board: the alarms of the plant; those of the signals are declared here.
        ranges: ranges of each input and of each output.
        numbers: numbers of the plant's stages, shape (1,), see `row_frame.FrameTypes`.

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
        self._board, self._numbers = board, numbers
        self._checks = [check(config, board, ranges) for check in CHECKS]
        self._row_checks, self._value_checks, self._residual_checks = (
            [check for check in self._checks if getattr(type(check), hook) is not getattr(SignalCheck, hook)]
            for hook in ("on_row", "on_values", "on_residuals")
        )
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
        """Rate of all false alarms by the errors of the training, in shares of one alarm, shape (draws,).

        Args:
            learned: prewhitening of each output.
            evaluated: for each output, True if it is evaluated.
            arl0: run length of each alarm without a fault, in rows.
            errors: errors of all outputs.
        """
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

    def check_row(self, time_ns: int, values: tuple[float, ...], changes: list[AlarmChange]) -> tuple[float, ...]:
        """Check a row, inputs first; returns its values, with NaN in place of those that are no measurements.

        Args:
            time_ns: time of the row.
            values: values of the row.
            changes: list to which changes of alarms are added.
        """
        for check in self._row_checks:
            invalid = self._find(check, check.on_row(time_ns, values), changes)
            if True in invalid:
                values = tuple(nan if is_invalid else value for value, is_invalid in zip(values, invalid, strict=True))
        return values

    def check_silence(self, now_ns: int) -> list[Publication]:
        """Check the plant's data timeout in receive time."""
        return self.publish(self.silence, now_ns, self.silence.check(now_ns))

    def check_values(
        self, time_ns: int, values: list[float], units: list[str], changes: list[AlarmChange]
    ) -> list[bool]:
        """Check the outputs of a row; returns flags of those whose readings are no measurements."""
        checks = self._value_checks
        flags = [self._find(check, check.on_values(time_ns, values, units), changes) for check in checks]
        return _join(flags, len(values))

    def check_residuals(
        self, time_ns: int, e: list[float], scales: list[float], units: list[str], changes: list[AlarmChange]
    ) -> list[bool]:
        """Check the residuals of a row; returns flags of the outputs whose value must not enter a memory yet."""
        checks = self._residual_checks
        flags = [self._find(check, check.on_residuals(time_ns, e, scales, units), changes) for check in checks]
        return _join(flags, len(e))

    def publish(self, check: SignalCheck, time_ns: int, findings: Sequence[Finding]) -> list[Publication]:
        """Alarms of a check that its findings raise or clear, outside of a row."""
        changes: list[AlarmChange] = []
        self._find(check, findings, changes)
        return self._board.apply(time_ns, changes)

    @staticmethod
    def _find(check: SignalCheck, findings: Sequence[Finding], changes: list[AlarmChange]) -> Flags:
        """Add the changes of a check's alarms; returns flags of the signals whose value is no measurement."""
        for i, judgement, unit, text, own_time_ns in findings:
            change = check.alarms[i].update(judgement, unit, own_time_ns)
            if change is None:
                continue
            if check.signals[i] != PLANT:
                change.contributions = {check.signals[i]: 1.0}
            change.text, change.suspects = text, [SuspectedCause(check.cause, 1.0, kind=SENSOR)]
            changes.append(change)
        return [alarm.memory.standing for alarm in check.alarms] if check.is_invalid_while_active else check.invalid

    def on_gap(self) -> None:
        """Forget what is quarantined, as after a gap."""
        for check in self._checks:
            check.on_gap()

    def on_restart(self) -> None:
        """Drop earlier rows: the publisher was restarted."""
        for check in self._checks:
            check.on_restart()


def _join(flags: Sequence[Flags], count: int) -> list[bool]:
    """Signals with a flag by any check."""
    given = [item for item in flags if item]
    return [any(item) for item in zip(*given, strict=True)] if given else [False] * count
