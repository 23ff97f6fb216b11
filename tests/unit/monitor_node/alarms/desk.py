"""A board of alarms, and points of its charts, made in the test."""

from typing import TypeVar

from google.protobuf.message import Message

from monitor_node.alarms.alarms import ChartAlarm
from monitor_node.alarms.annunciator import Annunciator
from monitor_node.config import MonitorConfig
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmKpis
from reactorwatch.records.record import to_time_ns
from reactorwatch.spc.charts.base import Judgement

M = TypeVar("M", bound=Message)

AT_ONCE = MonitorConfig(raise_count=1, window=1, clear_count=1)
"""One point out raises an alarm, one back in clears it."""


class Desk:
    """A board with alarms of charts whose centre is 0 and whose limits are -3 and 3.

    Attributes:
        published: everything published so far.
    """

    def __init__(self, config: MonitorConfig = AT_ONCE, signals: tuple[str, ...] = ("C", "T")) -> None:
        self.board = Annunciator(config)
        self.alarms = {signal: self.board.declare("shewhart", signal) for signal in signals}
        self.published: list[Publication] = []

    def point(self, minutes: float, **values: float) -> None:
        """A row: the statistic of each signal named."""
        for signal, value in values.items():
            judgement = Judgement(value, 0.0, -3.0, 3.0, abs(value) > 3.0)
            self.judge(self.alarms[signal], minutes, judgement)
        self.published += self.board.end_row(to_time_ns(minutes))

    def judge(self, alarm: ChartAlarm, minutes: float, judgement: Judgement) -> None:
        """A point of an alarm's chart."""
        change = alarm.update(judgement, "K")
        if change is not None:
            change.text = f"{alarm.name} is out"
            self.published += self.board.apply(to_time_ns(minutes), [change])

    def messages(self, kind: type[M]) -> list[M]:
        """The messages of a kind."""
        return [item.message for item in self.published if isinstance(item.message, kind)]

    def changes(self) -> list[tuple[str, str]]:
        """(alarm, event) of every change."""
        return [(alarm.alarm, alarm.event) for alarm in self.messages(Alarm)]

    def figures(self) -> AlarmKpis:
        """The newest KPIs."""
        return self.messages(AlarmKpis)[-1]

    def alarm(self, signal: str = "T") -> ChartAlarm:
        """The alarm of a signal."""
        return self.alarms[signal]
