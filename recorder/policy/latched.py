"""Latched messages repeated at the start of each file, so that every file is self-contained. Pure.

Models, alarms, baselines, promises and faults are published when they change. A file in which none changes would not
contain them. So the last message of each is repeated at the start of a file, marked as `RecordedMessage.latched`, with
the time of its sample and with the start time of the file as its time of receipt.
"""

from google.protobuf.message import Message

from reactorwatch.contract import messages_pb2 as messages
from recorder.message import RecordedMessage
from recorder.policy.channel_budget import MAX_KEYS

STATES = frozenset({messages.ModelSnapshot, messages.Alarm, messages.Baseline, messages.Promise, messages.Fault})
"""Types of messages that are latched."""


class LatchedMessages:
    """Last message of each model, alarm, baseline, promise and fault.

    Args:
        capacity: largest number of messages; beyond it the oldest is dropped.
    """

    def __init__(self, capacity: int = MAX_KEYS // 2) -> None:
        self._capacity = capacity
        self._last: dict[tuple[str, tuple[str, bool, bool]], RecordedMessage] = {}

    def update(self, recorded: RecordedMessage, message: Message) -> None:
        """Process a recorded message and its decoded content."""
        if isinstance(message, messages.ModelSnapshot):
            # models that share a key: the adaptive one, the one held since the training, the reference
            name = (recorded.key, (message.structure, message.reference, message.held))
        elif type(message) in STATES:
            name = (recorded.key, ("", False, False))
        else:
            return
        self._last.pop(name, None)
        self._last[name] = recorded
        if len(self._last) > self._capacity:
            del self._last[next(iter(self._last))]

    def messages(self, start_ns: int) -> list[RecordedMessage]:
        """Messages to repeat in a file that starts at `start_ns`, in the order of receipt."""
        return [item._replace(log_time_ns=start_ns, latched=True) for item in self._last.values()]
