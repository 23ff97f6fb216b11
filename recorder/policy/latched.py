"""What a new file says first, so that it opens by itself: how things stand when it is begun. Pure.

Models and alarms are told when they change, and a file in which nothing changes would say nothing of them. So the last
message of each is said again at its start, marked as such (`Entry.repeated`), with the time of its sample and with the
time of the file's beginning as that of receipt.
"""

from google.protobuf.message import Message

from reactorwatch.contract import messages_pb2 as messages
from recorder.message import Entry
from recorder.policy.room import MOST_KEYS


class Head:
    """The last message of each model, alarm and fault.

    Args:
        most: messages that are remembered; of more, the oldest are forgotten.
    """

    def __init__(self, most: int = MOST_KEYS // 2) -> None:
        self._most = most
        self._last: dict[tuple[str, tuple[str, bool, bool]], Entry] = {}

    def remember(self, entry: Entry, message: Message) -> None:
        """Look at an entry and what it holds."""
        if isinstance(message, messages.ModelSnapshot):
            # models that share a key: the one that adapts, the one held since the training, the one that judges
            name = (entry.key, (message.structure, message.reference, message.held))
        elif isinstance(message, messages.Alarm | messages.Fault):
            name = (entry.key, ("", False, False))
        else:
            return
        self._last.pop(name, None)
        self._last[name] = entry
        if len(self._last) > self._most:
            del self._last[next(iter(self._last))]

    def entries(self, begun_ns: int) -> list[Entry]:
        """What is to be said again, in the order in which it came.

        Args:
            begun_ns: when the file is begun.
        """
        return [entry._replace(log_time_ns=begun_ns, repeated=True) for entry in self._last.values()]
