"""Plants that are adopted as soon as their history is recovered: the stored state, and messages since.

Messages of such a plant are buffered and follow its history. A sample that is in both is used once.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from monitor_node.ingest.sample_limits import LARGEST_SAMPLE
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded

MOST_KEPT = 100_000
"""Buffered messages of all such plants; further ones are lost, unless the history has them."""

LARGEST_KEPT = 1 << 16
"""Bytes of other payloads than samples: no alarm is as large."""


def truncate(message: Encoded) -> Encoded:
    """Truncate a message that is too large: it is still rejected, and buffers stay bounded."""
    if len(message.payload) <= LARGEST_SAMPLE:
        return message
    topic = keys.parse(message.key)
    largest = LARGEST_SAMPLE if topic is not None and topic.kind == keys.SAMPLE else LARGEST_KEPT
    return message._replace(payload=message.payload[: largest + 1])


class PlantHistory(NamedTuple):
    """Recovered history of a plant.

    Attributes:
        plant: name of the plant.
        state: state that its monitor stored last; None if there is none.
        messages: messages that its publishers still remember, in order.
        alarms: alarms of the plant that running monitors have published lately.
    """

    plant: str
    state: bytes | None
    messages: list[Encoded]
    alarms: Sequence[Encoded] = ()


class PendingPlants:
    """Plants whose history is being recovered, and their buffered messages."""

    def __init__(self) -> None:
        self._kept: dict[str, list[Encoded]] = {}
        self._count = 0

    def __contains__(self, plant: str) -> bool:
        return plant in self._kept

    def start(self, plant: str) -> None:
        """Start to buffer a plant's messages."""
        self._kept[plant] = []

    def add(self, plant: str, message: Encoded) -> None:
        """Buffer a message of a plant."""
        if self._count < MOST_KEPT:
            self._kept[plant].append(truncate(message))
            self._count += 1

    def end(self, plant: str, history: Iterable[Encoded] = ()) -> list[Encoded]:
        """Remove a plant; returns its history, followed by the buffered messages that are not in it."""
        before, kept = list(history), self._kept.pop(plant)
        self._count -= len(kept)
        given = {(message.key, message.payload) for message in before}
        return before + [message for message in kept if (message.key, message.payload) not in given]
