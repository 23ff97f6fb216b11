"""Plants that nobody vouches for yet: a stranger may make up names, and each costs a monitor.

A plant is vouched for by a liveliness token of one of its nodes, by a state that was stored of it, or by what it says:
by rows that were lined up, or, if it is another's to watch, by messages. Until then it is one of a limited number. If
there are so many already, others wait until one of them has proved itself, or is forgotten because it has said nothing
for long. So names use up neither memory nor the places of plants that show a token.
"""

from dataclasses import dataclass

MOST_STRANGERS = 1000

PROVEN_ROWS, PROVEN_MESSAGES = 32, 96

FORGET_NS = 600_000_000_000
"""A plant without a token that says less than one thing in this time is not watched."""


@dataclass(slots=True)
class _Heard:
    at_ns: int
    messages: int = 0


class Strangers:
    """The plants that nobody vouches for.

    Attributes:
        forgotten: how many of them were forgotten.
    """

    def __init__(self) -> None:
        self._heard: dict[str, _Heard] = {}  # by plant; who was heard last stands last
        self.forgotten = 0

    def __contains__(self, plant: str) -> bool:
        return plant in self._heard

    @property
    def have_room(self) -> bool:
        """Whether there may be one more."""
        return len(self._heard) < MOST_STRANGERS

    def meet(self, plant: str, now_ns: int) -> None:
        """A plant was heard of that nobody vouches for."""
        self._heard[plant] = _Heard(now_ns)

    def hear(self, plant: str, now_ns: int) -> int:
        """One of them said something; returns how often it has."""
        heard = self._heard[plant] = self._heard.pop(plant)
        heard.at_ns = now_ns
        heard.messages += 1
        return heard.messages

    def vouch(self, plant: str) -> None:
        """A plant is none of them any more, if it was one."""
        self._heard.pop(plant, None)

    def forget(self, now_ns: int) -> list[str]:
        """Forget those that have said nothing for long; returns them."""
        plants: list[str] = []
        for plant, heard in self._heard.items():
            if now_ns - heard.at_ns < FORGET_NS:
                break
            plants.append(plant)
        for plant in plants:
            del self._heard[plant]
        self.forgotten += len(plants)
        return plants
