"""Time intervals around alarms that are kept permanently. Pure.

All times are times of receipt. An alarm that is raised before the current interval ends extends it, because both belong
to one event. An interval has a largest length; the next alarm after it starts a new one.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

from google.protobuf.message import Message

from reactorwatch.contract import messages_pb2 as messages

MAX_MARGINS = 10
"""Largest time from the first alarm to the end of an interval, in margins."""
RAISED = "raised"
"""Event of an alarm that is raised."""


@dataclass(frozen=True)
class AlarmInterval:
    """Time interval around one or several alarms.

    Attributes:
        from_ns: start of the interval.
        to_ns: end of the interval.
        raised_ns: time of receipt of the first alarm.
        alarm: name of the first alarm.
    """

    from_ns: int
    to_ns: int
    raised_ns: int
    alarm: str


class BlackBox:
    """Derives the intervals to keep from a plant's alarms.

    Args:
        margin_ns: time kept before and after an alarm; 0 keeps nothing.
        own: names of the recorder's own alarms, which start no interval.
    """

    def __init__(self, margin_ns: int, own: Collection[str] = ()) -> None:
        self._margin_ns = margin_ns
        self._own = own
        self._open: AlarmInterval | None = None

    def on_message(self, message: Message, received_ns: int) -> AlarmInterval | None:
        """Process a message.

        Returns:
            The interval that ended before this alarm started a new one; usually None.
        """
        if not self._margin_ns or not isinstance(message, messages.Alarm):
            return None
        if message.event != RAISED or message.alarm in self._own:
            return None
        ended = self.pop_ended(received_ns)
        end_ns = received_ns + self._margin_ns
        if self._open is None:
            self._open = AlarmInterval(received_ns - self._margin_ns, end_ns, received_ns, message.alarm)
        else:
            end_ns = min(end_ns, self._open.raised_ns + MAX_MARGINS * self._margin_ns)
            self._open = replace(self._open, to_ns=max(self._open.to_ns, end_ns))
        return ended

    def pop_ended(self, now_ns: int) -> AlarmInterval | None:
        """Return the interval that has ended, once; None if there is none."""
        if self._open is None or now_ns <= self._open.to_ns:
            return None
        return self.close()

    def close(self) -> AlarmInterval | None:
        """End the current interval now and return it; None if there is none."""
        ended, self._open = self._open, None
        return ended

    def protected_ns(self, now_ns: int) -> int | None:
        """Length of the most recent time of which nothing may be deleted, as an alarm needs it; None if all may be."""
        if not self._margin_ns:
            return None
        return max(self._margin_ns, now_ns - self._open.from_ns if self._open is not None else 0)

    @property
    def longest_ns(self) -> int:
        """Largest length of an interval: older alarms cannot belong to the current one."""
        return (MAX_MARGINS + 1) * self._margin_ns

    @property
    def next_due_ns(self) -> int | None:
        """Time at which the current interval ends if no other alarm is raised."""
        return self._open.to_ns + 1 if self._open is not None else None
