"""Plants that are to be watched as soon as their past is known: what was stored of them, and what they said since.

What comes of a plant meanwhile is kept, and follows what was told of before. A sample may be in both; it is taken once.
"""

from collections.abc import Iterable
from typing import NamedTuple

from monitor_node.ingest.sample_limits import LARGEST_SAMPLE
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded

MOST_KEPT = 100_000
"""Messages of all such plants; what comes beyond that is lost, unless it is told as being of before."""


LARGEST_KEPT = 1 << 16
"""Of other payloads than samples: no alarm is as large."""


def cut(message: Encoded) -> Encoded:
    """So much of a message that it is refused if it is too large: what waits must take no more room."""
    if len(message.payload) <= LARGEST_SAMPLE:
        return message
    topic = keys.parse(message.key)
    largest = LARGEST_SAMPLE if topic is not None and topic.kind == keys.SAMPLE else LARGEST_KEPT
    return message._replace(payload=message.payload[: largest + 1])


class Past(NamedTuple):
    """What is known of a plant from before.

    Attributes:
        plant: its name.
        state: as its monitor stored it last; None: there is none.
        messages: that it published, as far as it remembers, in their order.
    """

    plant: str
    state: bytes | None
    messages: list[Encoded]


class Arrivals:
    """The plants that are waited for, and what has come of them."""

    def __init__(self) -> None:
        self._kept: dict[str, list[Encoded]] = {}
        self._count = 0

    def __contains__(self, plant: str) -> bool:
        return plant in self._kept

    def begin(self, plant: str) -> None:
        """From now on what comes of a plant is kept."""
        self._kept[plant] = []

    def keep(self, plant: str, message: Encoded) -> None:
        """Keep what came of a plant that is waited for."""
        if self._count < MOST_KEPT:
            self._kept[plant].append(cut(message))
            self._count += 1

    def end(self, plant: str, told: Iterable[Encoded] = ()) -> list[Encoded]:
        """Wait for a plant no longer; returns what was told of before, and then what came since.

        Args:
            plant: its name.
            told: what it published before.
        """
        before, kept = list(told), self._kept.pop(plant)
        self._count -= len(kept)
        known = {(message.key, message.payload) for message in before}
        return before + [message for message in kept if (message.key, message.payload) not in known]
