"""Which stretches of time are kept for good: before and after each alarm. Pure.

All times are those of receipt. Alarms that come up before the time after the last one is over share a stretch, because
they are of one story; one that goes on and on is ended, and the next alarm begins a new one.
"""

from collections.abc import Collection
from dataclasses import dataclass

from google.protobuf.message import Message

from reactorwatch.contract import messages_pb2 as messages

LONGEST = 10
"""Times what is kept after an alarm: how long alarms may go on in one stretch."""
RAISED = "raised"
"""The event of an alarm that comes up."""


@dataclass(frozen=True)
class Stretch:
    """A stretch of time around one alarm, or several.

    Attributes:
        from_ns: where it begins.
        to_ns: where it ends.
        raised_ns: when the first of its alarms was received.
        alarm: the first of them.
    """

    from_ns: int
    to_ns: int
    raised_ns: int
    alarm: str


class BlackBox:
    """Follows the alarms of a plant.

    Args:
        around_ns: how much is kept before and after an alarm; 0: nothing is.
        own: alarms of these names are the recorder's, and of no plant.
    """

    def __init__(self, around_ns: int, own: Collection[str] = ()) -> None:
        self._around_ns = around_ns
        self._own = own
        self._open: Stretch | None = None

    def on_message(self, message: Message, received_ns: int) -> Stretch | None:
        """Look at a message.

        Returns:
            A stretch that is over because this alarm begins a new one; most often None.
        """
        if not self._around_ns or not isinstance(message, messages.Alarm):
            return None
        if message.event != RAISED or message.alarm in self._own:
            return None
        over = self.over(received_ns)
        around = Stretch(received_ns - self._around_ns, received_ns + self._around_ns, received_ns, message.alarm)
        if self._open is None:
            self._open = around
        else:
            first = self._open
            last_ns = min(around.to_ns, first.raised_ns + LONGEST * self._around_ns)
            self._open = Stretch(first.from_ns, max(first.to_ns, last_ns), first.raised_ns, first.alarm)
        return over

    def over(self, now_ns: int) -> Stretch | None:
        """The stretch that has come to its end, once; None if there is none."""
        if self._open is None or now_ns <= self._open.to_ns:
            return None
        return self.close()

    def close(self) -> Stretch | None:
        """The stretch that is under way, ended now; None if there is none."""
        ended, self._open = self._open, None
        return ended

    def needed_ns(self, now_ns: int) -> int | None:
        """The last span of time of which nothing must be deleted: an alarm came, or may come now; None: all may be."""
        if not self._around_ns:
            return None
        return max(self._around_ns, now_ns - self._open.from_ns if self._open is not None else 0)

    @property
    def reach_ns(self) -> int:
        """For how long an alarm may matter to the stretch that is under way: that of the longest."""
        return (LONGEST + 1) * self._around_ns

    @property
    def next_due_ns(self) -> int | None:
        """When a stretch ends, if nothing happens until then."""
        return self._open.to_ns + 1 if self._open is not None else None
