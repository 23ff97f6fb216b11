"""Sharding of a fleet: the assignment of plants to monitors.

Several monitors may share a fleet: each has a shard of it, `2/5` is the second of five. Every plant has a home shard,
by a digest of its name, the same on every machine and in every version. When the monitors of a shard are gone, each of
its plants goes to the highest-ranked of the shards that are alive: rendezvous hashing (Thaler & Ravishankar 1998, Using
name-based mappings to increase hit rates, IEEE/ACM Trans. Networking 6(1)). So these plants are spread over the other
shards, and no other plant moves.

Two monitors may have the same shard; the one whose name sorts first is active, and the other on standby.

Liveliness tokens show which monitors are alive, and each monitor draws the same conclusion from them. A shard whose
token was never seen is presumed to be starting, until `drop_unseen`; then it counts as gone.
"""

import re
from collections.abc import Collection
from hashlib import blake2b
from typing import NamedTuple

from reactorwatch.contract import keys
from reactorwatch.errors import InputError

LARGEST = 1000
"""Largest number of shards of a fleet."""


class Shard(NamedTuple):
    """A shard of a fleet.

    Attributes:
        number: number of the shard, from 1.
        of: number of shards.
    """

    number: int
    of: int

    def __str__(self) -> str:
        return f"{self.number}/{self.of}"


WHOLE = Shard(1, 1)


def parse_shard(text: str) -> Shard:
    """Parse a shard.

    >>> parse_shard("2/5")
    Shard(number=2, of=5)

    Raises:
        InputError: the text is no shard.
    """
    match = re.fullmatch(r"(\d{1,4})/(\d{1,4})", text)
    shard = Shard(int(match[1]), int(match[2])) if match is not None else Shard(0, 0)
    if not 1 <= shard.number <= shard.of <= LARGEST:
        raise InputError(f"shard must be like 2/5, the second of five, with at most {LARGEST}, got {text!r}")
    return shard


def _digest(text: str) -> int:
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "big")


def home_shard(plant: str, of: int) -> int:
    """Home shard of a plant, from 1.

    Args:
        plant: name of the plant.
        of: number of shards.
    """
    return _digest(plant) % of + 1


def owner(plant: str, of: int, alive: Collection[int]) -> int | None:
    """Shard that owns a plant now; None if no shard is alive.

    Args:
        plant: name of the plant.
        of: number of shards.
        alive: shards that are alive.
    """
    at_home = home_shard(plant, of)
    if at_home in alive or not alive:
        return at_home if alive else None
    return max(alive, key=lambda number: (_digest(f"{plant}/{number}"), number))


class ShardGroup:
    """The monitors that share a fleet, as one of them sees them.

    Args:
        fleet: key expression of the fleet's plants.
        shard: own shard.
        name: own unique name.

    Attributes:
        is_shared: True if there is, or was, another monitor.
    """

    def __init__(self, fleet: str, shard: Shard, name: str) -> None:
        self._fleet = blake2b(fleet.encode(), digest_size=8).hexdigest()
        self._shard, self._name = shard, keys.fleet_member(name, fleet)
        self._names: dict[int, set[str]] = {shard.number: {self._name}}
        self._unseen = set(range(1, shard.of + 1)) - {shard.number}
        self.is_shared = shard.of > 1

    @property
    def token(self) -> str:
        """Own liveliness token."""
        return keys.fleet_token(self._fleet, str(self._shard.of), str(self._shard.number), self._name)

    def on_token(self, token: str, *, is_alive: bool) -> bool:
        """Update with a liveliness token; returns True if it is of this fleet.

        Args:
            token: token of a monitor.
            is_alive: True if the token was declared, False if it was undeclared.
        """
        member = keys.parse_fleet_token(token)
        if member is None or (member.fleet, member.of) != (self._fleet, str(self._shard.of)):
            return False
        if not member.number.isdigit():
            return False
        names = self._names.setdefault(int(member.number), set())
        self.is_shared = self.is_shared or member.name != self._name
        if is_alive:
            names.add(member.name)
            self._unseen.discard(int(member.number))
        elif member.name != self._name:  # this monitor itself is alive
            names.discard(member.name)
        return True

    def drop_unseen(self) -> bool:
        """Drop shards that were never seen; returns True if there are any."""
        unseen, self._unseen = self._unseen, set()
        return bool(unseen)

    def is_ours(self, plant: str) -> bool:
        """True if this monitor owns a plant now."""
        alive = {number for number, names in self._names.items() if names} | self._unseen
        if owner(plant, self._shard.of, alive) != self._shard.number:
            return False
        return min(self._names[self._shard.number]) == self._name
