"""A check of the signals themselves: one call a row returns findings, which raise and clear the check's alarms.

The statistical method of a check is in `reactorwatch.spc`; a check feeds it, and states what it finds.
"""

from collections.abc import Mapping, Sequence
from math import nan
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import numpy as np

from monitor_node.alarms.alarms import AlarmChange, SuspectedCause
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.config import MonitorConfig
from monitor_node.watched_process import SignalRange
from reactorwatch.arrays import Array
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.false_alarm_budget import TrainingErrors
from reactorwatch.spc.prewhitening import Prewhitening

PLANT = "plant"
"""Name in place of a signal for alarms of all signals together."""

SENSOR = "sensor"
"""Kind of the causes that checks suspect."""

Judged: TypeAlias = Literal["signals", "outputs", "residuals"]
"""Values that a check judges, in the order in which a row has them: all signals, inputs first; outputs; residuals.

Before the end of the training only signals are judged.
"""

Flags = Sequence[bool]


class CheckRow(NamedTuple):
    """A row as a check sees it.

    Attributes:
        time_ns: time of the row.
        values: values that the check judges, of residuals the prewhitened ones; NaN where there is none.
        units: units of the outputs.
        scales: one standard deviation of each residual, in the outputs' units; empty if none are judged.
    """

    time_ns: int
    values: Sequence[float]
    units: Sequence[str]
    scales: Sequence[float] = ()

    def without(self, invalid: Flags) -> list[float]:
        """Values of the row, with NaN in place of those that are no measurements."""
        return [nan if flag else value for value, flag in zip(self.values, invalid, strict=True)]


class CheckTraining(NamedTuple):
    """Training of a check, with one entry an output in each field but the last two.

    Attributes:
        values: readings in order of time; NaN where missing, and all NaN for an excluded output.
        e: prewhitened residuals; NaN where there are none.
        outliers: number of outliers.
        period_ns: sampling period.
        arl0: run length of each alarm without a fault, in rows.
    """

    values: list[list[float]]
    e: list[list[float]]
    outliers: Sequence[int]
    period_ns: float
    arl0: float


class Finding(NamedTuple):
    """Judgement of one signal of a row.

    Attributes:
        signal: index of the signal among the check's `signals`.
        judgement: judgement; the alarm is raised if it is out, and cleared if it is not.
        unit: unit of the statistic.
        text: text of the alarm, if it is raised.
        time_ns: time of the judgement; None: that of the row.
    """

    signal: int
    judgement: Judgement
    unit: str = ""
    text: str = ""
    time_ns: int | None = None


class SignalCheck:
    """One check of the signals of one plant.

    Args:
        config: configuration of the monitor.
        board: the alarms of the plant; those of the check are declared there.
        ranges: ranges of each input and of each output.
        signals: names of the signals with an alarm; None: the outputs.

    Attributes:
        name: name of its alarms.
        cause: suspected cause of its alarms.
        judged: the values that it judges.
        options: options of its alarms, see `Annunciator.declare`.
        can_be_false: whether chance can raise its alarms, one an output, which then share the promised false alarms.
        is_invalid_while_active: whether a value is no measurement while its alarm is active.
        memory: all that it remembers but the alarms, as it is stored: changed by training and rows, never replaced;
            None: nothing.
        invalid: one flag a value of the newest row: it is no measurement; empty: all are.
    """

    name: ClassVar[str]
    cause: ClassVar[str]
    judged: ClassVar[Judged] = "outputs"
    options: ClassVar[Mapping[str, Any]] = {}
    can_be_false: ClassVar[bool] = False
    is_invalid_while_active: ClassVar[bool] = False
    memory: Any = None
    invalid: Flags = ()

    def __init__(
        self,
        config: MonitorConfig,
        board: Annunciator,
        ranges: Sequence[SignalRange],
        signals: Sequence[str] | None = None,
    ) -> None:
        self.config, self.board, self.ranges, self.outputs = config, board, ranges, config.outputs
        self.signals = config.outputs if signals is None else signals
        options = {"without_on_delay": True, "names_cause": True} | dict(self.options)
        self.alarms = [board.declare(self.name, signal, **options) for signal in self.signals]

    @property
    def is_ordinary(self) -> bool:
        """True if only the numbers of a compiled check change with the next row, unless that row is an event."""
        return True

    def use_numbers(self, numbers: np.void) -> None:
        """Keep numbers of the memory in those of the plant (`row_frame`) from now on.

        Raises:
            ValueError: they are of other signals.
        """

    def start(self, training: CheckTraining) -> None:
        """Learn from the training."""

    def relative_rates(self, learned: Sequence[Prewhitening], arl0: float, errors: TrainingErrors) -> Array:
        """Rate of false alarms by the errors of the training, in shares of one alarm, shape (draws, outputs).

        After `start`; of a check that chance can raise. Where it is not known, each has its share.

        Args:
            learned: prewhitening of each output.
            arl0: run length of each alarm without a fault, in rows.
            errors: errors of all outputs.
        """
        return np.ones_like(errors.mean)

    def update(self, row: CheckRow) -> list[Finding]:
        """Check a row. A finding that is out raises its alarm, another one clears it."""
        raise NotImplementedError

    def changes(self, findings: Sequence[Finding]) -> list[AlarmChange]:
        """Changes of the check's alarms by its findings."""
        changes: list[AlarmChange] = []
        for i, judgement, unit, text, time_ns in findings:
            change = self.alarms[i].update(judgement, unit, time_ns)
            if change is not None:
                if self.signals[i] != PLANT:
                    change.contributions = {self.signals[i]: 1.0}
                change.text, change.suspects = text, [SuspectedCause(self.cause, 1.0, kind=SENSOR)]
                changes.append(change)
        return changes

    def on_gap(self) -> None:
        """Forget what a gap in the rows makes undecidable."""

    def on_restart(self) -> None:
        """Forget the rows seen: the plant's publisher was restarted."""
        self.on_gap()
