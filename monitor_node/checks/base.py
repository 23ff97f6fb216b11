"""A check of the signals themselves: hooks on the way of a row, which return judgements for the check's alarms.

A row passes the hooks in the order in which they stand here. Before the end of the training only `on_row` is called.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.config import MonitorConfig
from monitor_node.learn.signal_range import SignalRange
from reactorwatch.arrays import Array
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.training_errors import TrainingErrors

PLANT = "plant"
"""Name in place of a signal for alarms of all signals together."""

Flags = Sequence[bool]


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
        options: options of its alarms, see `Annunciator.declare`.
        can_be_false: whether chance can raise its alarms, one an output, which then share the promised false alarms.
        is_invalid_while_active: whether a value is no measurement while its alarm is active.
        memory: all that it remembers but the alarms, as it is stored; None: nothing.
        invalid: True for each signal of the newest row whose value is no measurement; empty if all are.
    """

    name: ClassVar[str]
    cause: ClassVar[str]
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

    def on_row(self, time_ns: int, values: tuple[float, ...]) -> list[Finding]:
        """Check a row, inputs first; values are NaN where missing."""
        return []

    def on_values(self, time_ns: int, values: list[float], units: list[str]) -> list[Finding]:
        """Check the outputs of a row."""
        return []

    def on_residuals(self, time_ns: int, e: list[float], scales: list[float], units: list[str]) -> list[Finding]:
        """Check the prewhitened residuals of a row; `invalid` are then values that must not enter a memory yet.

        Args:
            time_ns: time of the row.
            e: prewhitened residual of each output; NaN where there is none.
            scales: one standard deviation of each, in the outputs' units.
            units: units of the outputs.
        """
        return []

    def on_gap(self) -> None:
        """Forget what a gap in the rows makes undecidable."""

    def on_restart(self) -> None:
        """Forget the rows seen: the plant's publisher was restarted."""
        self.on_gap()
