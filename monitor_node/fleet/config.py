"""Settings of a fleet, and its division into shards.

Each monitor of a divided fleet has one shard: `2/5` is the second of five. A plant's shard follows from a digest of its
name, the same on every machine and in every version, and never changes.
"""

import re
from hashlib import blake2b
from typing import Annotated, NamedTuple

import msgspec

from monitor_node.config import LARGEST_FALSE_ALARMS, LEAST_FALSE_ALARMS, MonitorConfig
from reactorwatch.contract import keys
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import check_bounds
from reactorwatch.spc.false_alarm_budget import DAYS

MOST_SHARDS = 1000


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

    def has(self, plant: str) -> bool:
        """True if a plant is in the shard."""
        return self.of == 1 or shard_of(plant, self.of) == self.number


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
    if not 1 <= shard.number <= shard.of <= MOST_SHARDS:
        raise InputError(f"shard must be like 2/5, the second of five, with at most {MOST_SHARDS}, got {text!r}")
    return shard


def shard_of(plant: str, of: int) -> int:
    """Number of a plant's shard, from 1.

    >>> [shard_of(plant, 3) for plant in ("a", "b", "c", "d")]
    [3, 3, 1, 3]

    Args:
        plant: name of the plant.
        of: number of shards.
    """
    return int.from_bytes(blake2b(plant.encode(), digest_size=8).digest(), "big") % of + 1


class FleetConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a fleet; those of the monitor apply to each of its plants.

    Attributes:
        plants: key expression of the plants, such as `reactor/*`; None: one plant, that of the monitor's settings.
        shard: own shard, such as `2/5`.
        processes: process by plant, a name in the catalogue or a file; a key may be a pattern of plants such as
            `north_*`, and a plant's own entry goes before patterns. Other plants have that of the monitor's settings.
        state: folder of the plants' states, stored as often as the monitor's settings say, from which a restarted
            monitor resumes. Only one monitor at a time uses a folder. None: nothing is stored.
        false_alarms_per_day: number of false alarms a day of all plants together; each plant has the same share, so it
            holds however the plants depend on each other. None: only each plant's own number is promised.
        most_plants: largest number of plants among which it is divided.
        points: True to publish estimates, chart points and models for every row.
    """

    plants: str | None = None
    shard: str = "1/1"
    processes: dict[str, str] = {}  # msgspec copies the default
    state: str | None = None
    false_alarms_per_day: Annotated[float, msgspec.Meta(ge=1e-4, le=1e6)] | None = None
    most_plants: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 100
    points: bool = False

    def __post_init__(self) -> None:
        if self.plants is not None:
            keys.check_plants(self.plants)
        try:
            parse_shard(self.shard)
        except InputError as error:
            raise ValueError(str(error)) from error
        check_bounds(FleetConfig, msgspec.structs.asdict(self))
        share = self.share_per_30_days
        if share is not None and not LEAST_FALSE_ALARMS <= share <= LARGEST_FALSE_ALARMS:
            raise ValueError(
                f"false_alarms_per_day over most_plants must be in [{LEAST_FALSE_ALARMS / DAYS:.2g}, "
                f"{LARGEST_FALSE_ALARMS / DAYS:.2g}], got {self.false_alarms_per_day:g} over {self.divisor} plants"
            )

    @property
    def divisor(self) -> int:
        """Number of plants among which the false alarms of the fleet are divided."""
        return self.most_plants if self.plants is not None and "*" in self.plants else 1

    @property
    def share_per_30_days(self) -> float | None:
        """Share of a plant in the false alarms of the fleet, in 30 days; None: nothing is promised for the fleet."""
        return None if self.false_alarms_per_day is None else DAYS * self.false_alarms_per_day / self.divisor

    def describe_excess(self, plants: int) -> str | None:
        """Text for more plants than share the false alarms of the fleet; None: there are not more."""
        promised = self.false_alarms_per_day
        if promised is None or plants <= self.divisor:
            return None
        return (
            f"the fleet has {plants} plants, and false_alarms_per_day is divided among {self.divisor}: up to "
            f"{promised * plants / self.divisor:.3g} false alarms a day may come; set [fleet] most_plants"
        )

    def share_promise(self, config: MonitorConfig) -> MonitorConfig:
        """Settings of a plant's monitor with its share of the false alarms, or its own number where that is smaller."""
        shares = [item for item in (self.share_per_30_days, config.false_alarms_per_30_days) if item is not None]
        return msgspec.structs.replace(config, false_alarms_per_30_days=min(shares, default=None))


ONE_PLANT = FleetConfig()
"""Settings where there is no fleet: the one plant of the monitor's settings is watched."""
