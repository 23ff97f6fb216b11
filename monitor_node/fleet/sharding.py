"""Which monitor of a fleet watches which plant.

Several monitors may share a fleet: each has a shard of it, `2/5` is the second of five. Every plant is at home in one
shard, by a digest of its name: all monitors know it without asking, on every machine and in every version. When the
monitors of a shard are gone, its plants go to the shards that are alive, each plant to the one that its name ranks
highest among them: rendezvous hashing (Thaler & Ravishankar 1998, Using name-based mappings to increase hit rates,
IEEE/ACM Trans. Networking 6(1)). So the plants of the dead are spread over those that live, and no other plant moves.

Two monitors may have the same shard; then the one whose name sorts first is in charge, and the other stands by.

Who is alive is told by liveliness tokens, and each monitor draws the same conclusion from them. A shard whose token was
never seen is taken for one that is being started, until `presume_gone`; then it counts as gone like any other.
"""

import re
from collections.abc import Collection
from hashlib import blake2b
from typing import NamedTuple

from reactorwatch.contract import keys
from reactorwatch.errors import InputError

LARGEST = 1000
"""Shards of a fleet."""


class Shard(NamedTuple):
    """A part of a fleet.

    Attributes:
        number: of the part, from 1 on.
        of: how many parts there are.
    """

    number: int
    of: int

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"


WHOLE = Shard(1, 1)


def parsed(text: str) -> Shard:
    """The shard that a text names.

    >>> parsed("2/5")
    Shard(number=2, of=5)

    Raises:
        InputError: it names none.
    """
    match = re.fullmatch(r"(\d{1,4})/(\d{1,4})", text)
    shard = Shard(int(match[1]), int(match[2])) if match is not None else Shard(0, 0)
    if not 1 <= shard.number <= shard.of <= LARGEST:
        raise InputError(f"shard must be like 2/5, the second of five, with at most {LARGEST}, got {text!r}")
    return shard


def _digest(text: str) -> int:
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "big")


def home(plant: str, of: int) -> int:
    """The shard that a plant is at home in, from 1 on.

    Args:
        plant: its name.
        of: how many shards there are.
    """
    return _digest(plant) % of + 1


def keeper(plant: str, of: int, living: Collection[int]) -> int | None:
    """The shard whose monitor watches a plant now; None if there is none.

    Args:
        plant: its name.
        of: how many shards there are.
        living: those that are alive.
    """
    at_home = home(plant, of)
    if at_home in living or not living:
        return at_home if living else None
    return max(living, key=lambda number: (_digest(f"{plant}/{number}"), number))


class Crew:
    """The monitors that share a fleet, as one of them sees it.

    Args:
        fleet: what they share: the key expression of its plants.
        shard: ours.
        name: ours, unlike all others'.

    Attributes:
        is_shared: whether there is anybody else, or ever was.
    """

    def __init__(self, fleet: str, shard: Shard, name: str) -> None:
        self._fleet = blake2b(fleet.encode(), digest_size=8).hexdigest()
        self._shard, self._name = shard, keys.fleet_member(name, fleet)
        self._names: dict[int, set[str]] = {shard.number: {self._name}}
        self._unseen = set(range(1, shard.of + 1)) - {shard.number}
        self.is_shared = shard.of > 1

    @property
    def token(self) -> str:
        """The liveliness token that we show."""
        return keys.fleet_token(self._fleet, str(self._shard.of), str(self._shard.number), self._name)

    def note(self, token: str, *, is_alive: bool) -> bool:
        """Take in that a monitor came or went; returns whether that was one of the fleet.

        Args:
            token: its.
            is_alive: whether it came.
        """
        found = keys.parse_fleet_token(token)
        if found is None or (found.fleet, found.of) != (self._fleet, str(self._shard.of)) or not found.number.isdigit():
            return False
        names = self._names.setdefault(int(found.number), set())
        self.is_shared = self.is_shared or found.name != self._name
        if is_alive:
            names.add(found.name)
            self._unseen.discard(int(found.number))
        elif found.name != self._name:  # ours is only gone if we are
            names.discard(found.name)
        return True

    def presume_gone(self) -> bool:
        """Take shards that were never seen for gone; returns whether there was any."""
        unseen, self._unseen = self._unseen, set()
        return bool(unseen)

    def is_ours(self, plant: str) -> bool:
        """Whether a plant is for us to watch now."""
        living = {number for number, names in self._names.items() if names} | self._unseen
        if keeper(plant, self._shard.of, living) != self._shard.number:
            return False
        return min(self._names[self._shard.number]) == self._name
