"""A check of the signals themselves: hooks on the way of a row, and the alarms that it raises.

A row passes the hooks in this order. Before the end of the training only `on_row` and `measured` are called.
"""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from monitor_node.alarms.alarms import ChartAlarm, Explanation, SuspectedCause
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.baseline.signal_range import SignalRange
from monitor_node.config import MonitorConfig
from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Publication
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.training_errors import TrainingErrors

PLANT = "plant"
"""Name in place of a signal for alarms of all signals together."""

SENSOR = "sensor"

Flags = tuple[bool, ...]


class SignalCheck:
    """One check of the signals of one plant.

    Args:
        config: configuration of the monitor.
        board: the alarms of the plant; the check declares its own there.
        ranges: ranges of each input and of each output.

    Attributes:
        name: name of its alarms.
        can_be_false: whether chance can raise its alarms, one an output, which then share the promised false alarms.
    """

    name: ClassVar[str]
    can_be_false: ClassVar[bool] = False

    def __init__(self, config: MonitorConfig, board: Annunciator, ranges: Sequence[SignalRange]) -> None:
        self.board, self.outputs = board, config.outputs

    @property
    def is_normal(self) -> bool:
        """True if only the numbers of a compiled check change with the next row, unless that row is an event."""
        return True

    @property
    def state(self) -> Any:
        """The full state; the alarms belong to the board."""
        return b""

    def restore(self, state: Any) -> None:
        """Resume from the state of a check with the same settings; after the board.

        Raises:
            ValueError: the state is damaged.
        """

    def start(self, values: list[list[float]], e: list[list[float]], arl0: float) -> None:
        """Learn from the training.

        Args:
            values: readings of each output, in order of time; NaN where missing, and all NaN for an excluded output.
            e: prewhitened residuals of each output; NaN where there are none.
            arl0: run length of each alarm without a fault, in rows.
        """

    def relative_rates(self, learned: Sequence[Prewhitening], arl0: float, errors: TrainingErrors) -> Array:
        """Rate of false alarms by the errors of the training, in shares of one alarm, shape (draws, outputs).

        After `start`; of a check that chance can raise. Where it is not known, each has its share.

        Args:
            learned: prewhitening of each output.
            arl0: run length of each alarm without a fault, in rows.
            errors: errors of all outputs.
        """
        return np.ones_like(errors.mean)

    def on_row(self, time_ns: int, values: tuple[float, ...]) -> list[Publication]:
        """Check a row, inputs first; values are NaN where missing."""
        return []

    def measured_values(
        self, time_ns: int, values: tuple[float, ...], publications: list[Publication]
    ) -> tuple[float, ...]:
        """Values of a row, inputs first, with NaN in place of those that are no measurements."""
        return values

    def on_values(self, time_ns: int, values: list[float], units: list[str]) -> list[Publication]:
        """Check the outputs of a row."""
        return []

    def invalid(self) -> list[bool]:
        """The outputs whose readings, by their alarms, are no measurements."""
        return [False] * len(self.outputs)

    def on_residuals(
        self, time_ns: int, e: list[float], scales: list[float], units: list[str], publications: list[Publication]
    ) -> Flags:
        """Check the prewhitened residuals of a row; returns the outputs whose value must not enter a memory yet.

        Args:
            time_ns: time of the row.
            e: prewhitened residual of each output; NaN where there is none.
            scales: one standard deviation of each, in the outputs' units.
            units: units of the outputs.
            publications: changes of alarms are added here.
        """
        return (False,) * len(self.outputs)

    def on_gap(self) -> None:
        """Forget what a gap in the rows makes undecidable."""

    def on_restart(self) -> None:
        """Forget the rows seen: the plant's publisher was restarted."""
        self.on_gap()

    def judge(
        self, alarm: ChartAlarm, time_ns: int, judgement: Judgement, unit: str, text: str, signal: str, *, cause: str
    ) -> list[Publication]:
        """Evaluate a point of an alarm; returns the alarm if it changes.

        Args:
            alarm: alarm of this check.
            time_ns: time of the row.
            judgement: judgement of the point.
            unit: unit of its statistic.
            text: text of the alarm, if the point raises it.
            signal: signal of the alarm.
            cause: suspected cause of the alarm.
        """
        raised = alarm.update(judgement)
        if raised is None:
            return []
        shares = {} if signal == PLANT else {signal: 1.0}
        explanation = Explanation(text, shares, [SuspectedCause(cause, 1.0, kind=SENSOR)]) if raised else None
        return [self.board.record_change(alarm, time_ns, judgement, unit, explanation)]
