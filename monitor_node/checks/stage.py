"""The checks of the signals of a plant, `CHECKS`, together.

None of them needs a model of what a fault looks like in the process, and each raises its alarm at once: a stuck sensor
after as many equal readings as its noise makes impossible, a spike with the value after it, a silence when the next
sample is overdue.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from monitor_node.alarms.alarms import AlarmChange
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.checks.base import CheckRow, CheckTraining, Judged, SignalCheck
from monitor_node.checks.signal_checks import RangeCheck, SilenceCheck, SpikeCheck, StuckCheck
from monitor_node.config import MonitorConfig
from monitor_node.watched_process import SignalRange
from reactorwatch.arrays import Array
from reactorwatch.spc.false_alarm_budget import TrainingErrors
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.stored_state import Records, read_memory

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
