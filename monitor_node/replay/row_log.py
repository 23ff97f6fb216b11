"""Log of the rows of a back-test: in which rows an alarm was active, and in which one was raised."""

from collections.abc import Sequence
from typing import NamedTuple

from monitor_node.alarms.states import Event
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm


class LoggedRow(NamedTuple):
    """A row and its alarms.

    Attributes:
        time_ns: time of the row.
        in_alarm: True if an alarm is active after the row, acknowledged or not.
        raised: True if an alarm was raised by the row.
    """

    time_ns: int
    in_alarm: bool
    raised: bool


class RowLog:
    """Follows the alarms from row to row."""

    def __init__(self) -> None:
        self.rows: list[LoggedRow] = []
        self._active: set[str] = set()

    def add(self, time_ns: int, publications: Sequence[Publication], *, judged: bool) -> None:
        """Add a row.

        Args:
            time_ns: time of the row.
            publications: publications because of the row.
            judged: False for a row of the training, which is logged without alarms.
        """
        raised = False
        for publication in publications:
            message = publication.message
            if not isinstance(message, Alarm):
                continue
            if message.event == Event.RAISED.value:
                self._active.add(message.alarm)
                raised = True
            elif message.event == Event.CLEARED.value or message.cleared_ns:
                self._active.discard(message.alarm)
        self.rows.append(LoggedRow(time_ns, judged and bool(self._active), judged and raised))


def rows_of_file(logged: Sequence[LoggedRow], times_ns: Sequence[int]) -> list[LoggedRow]:
    """Rows of a file with their alarms.

    Args:
        logged: the rows that were watched, in the order of the file.
        times_ns: times of the file's rows; one without any value was not watched, and its alarms are those before it.

    Returns:
        One row for each time.
    """
    rows: list[LoggedRow] = []
    index = 0
    for time_ns in times_ns:
        if index < len(logged) and logged[index].time_ns == time_ns:
            rows.append(logged[index])
            index += 1
        else:
            rows.append(LoggedRow(time_ns, bool(rows) and rows[-1].in_alarm, raised=False))
    return rows
