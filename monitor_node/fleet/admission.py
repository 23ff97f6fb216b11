"""Register of plants, and admission of unverified ones: anyone may publish under invented names, each costs a monitor.

A plant is verified by a liveliness token of one of its nodes, by a stored state, or by its data: by aligned rows, or by
messages if another shard owns it. The number of unverified plants is limited. At the limit, further plants wait until
one is verified, or evicted because it has sent nothing for long. So invented names use up neither memory nor the
capacity for plants with a token.
"""

from dataclasses import dataclass

from reactorwatch.contract import keys

MOST_PLANTS = 100_000

MOST_UNVERIFIED = 1000

PROVEN_ROWS, PROVEN_MESSAGES = 32, 96

EVICT_NS = 600_000_000_000
"""An unverified plant without a message in this time is evicted."""


@dataclass(slots=True)
class _Activity:
    at_ns: int
    messages: int = 0


class PlantRegister:
    """All plants, with any owner, and those of them that are unverified.

    Attributes:
        evicted: number of evicted plants.
    """

    def __init__(self) -> None:
        self._plants: dict[str, None] = {}
        self._activity: dict[str, _Activity] = {}  # by plant, the least recent first
        self.evicted = 0

    def __contains__(self, plant: str) -> bool:
        return plant in self._plants

    def __len__(self) -> int:
        return len(self._plants)

    @property
    def plants(self) -> list[str]:
        """All plants."""
        return list(self._plants)

    def register(self, plant: str, now_ns: int, *, verified: bool) -> bool:
        """Register a plant; returns True if it is new, has a valid name, and is below the limits.

        Args:
            plant: name of the plant.
            now_ns: present time.
            verified: True if the plant certainly exists; a registered plant is verified then.
        """
        if plant in self._plants:
            if verified:
                self.verify(plant)
            return False
        if len(self._plants) >= MOST_PLANTS or not (verified or len(self._activity) < MOST_UNVERIFIED):
            return False
        try:
            keys.check_plant(plant)
        except ValueError:
            return False
        self._plants[plant] = None
        if not verified:
            self._activity[plant] = _Activity(now_ns)
        return True

    def add(self, plant: str) -> None:
        """Register a plant that is adopted."""
        self._plants[plant] = None

    def is_unverified(self, plant: str) -> bool:
        """True for a plant that is not verified."""
        return plant in self._activity

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
            del self._activity[plant], self._plants[plant]
        self.evicted += len(plants)
        return plants
