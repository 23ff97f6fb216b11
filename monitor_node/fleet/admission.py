"""Admission of unverified plants: anyone may publish under invented names, and each costs a monitor.

A plant is verified by a liveliness token of one of its nodes, by a stored state, or by its data: by aligned rows, or by
messages if another shard owns it. The number of unverified plants is limited. At the limit, further plants wait until
one is verified, or evicted because it has sent nothing for long. So invented names use up neither memory nor the
capacity for plants with a token.
"""

from dataclasses import dataclass

MOST_UNVERIFIED = 1000

PROVEN_ROWS, PROVEN_MESSAGES = 32, 96

EVICT_NS = 600_000_000_000
"""An unverified plant without a message in this time is evicted."""


@dataclass(slots=True)
class _Activity:
    at_ns: int
    messages: int = 0


class UnverifiedPlants:
    """The unverified plants.

    Attributes:
        evicted: number of evicted plants.
    """

    def __init__(self) -> None:
        self._activity: dict[str, _Activity] = {}  # by plant, the least recent first
        self.evicted = 0

    def __contains__(self, plant: str) -> bool:
        return plant in self._activity

    @property
    def has_capacity(self) -> bool:
        """True below the limit."""
        return len(self._activity) < MOST_UNVERIFIED

    def add(self, plant: str, now_ns: int) -> None:
        """Register an unverified plant."""
        self._activity[plant] = _Activity(now_ns)

    def on_message(self, plant: str, now_ns: int) -> int:
        """Count a message of an unverified plant; returns the count."""
        heard = self._activity[plant] = self._activity.pop(plant)
        heard.at_ns = now_ns
        heard.messages += 1
        return heard.messages

    def verify(self, plant: str) -> None:
        """Verify a plant."""
        self._activity.pop(plant, None)

    def evict(self, now_ns: int) -> list[str]:
        """Evict plants without recent messages; returns them."""
        plants: list[str] = []
        for plant, heard in self._activity.items():
            if now_ns - heard.at_ns < EVICT_NS:
                break
            plants.append(plant)
        for plant in plants:
            del self._activity[plant]
        self.evicted += len(plants)
        return plants
