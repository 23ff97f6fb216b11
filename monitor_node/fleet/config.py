"""Settings of a fleet."""

from typing import Annotated

import msgspec

from monitor_node.config import LARGEST_FALSE_ALARMS, LEAST_FALSE_ALARMS, MonitorConfig
from monitor_node.fleet import sharding
from reactorwatch.contract import keys
from reactorwatch.errors import InputError
from reactorwatch.runtime.setting_rules import check_bounds
from reactorwatch.spc.false_alarm_budget import DAYS


class FleetConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a fleet; those of the monitor apply to each of its plants.

    Attributes:
        plants: key expression of the plants, such as `reactor/*`; None: one plant, that of the monitor's settings.
        shard: own shard, such as `2/5`: its plants, and those of shards whose monitors are gone.
        processes: process by plant, a name in the catalogue or a file; a key may be a pattern of plants such as
            `north_*`, and a plant's own entry goes before patterns. Other plants have that of the monitor's settings.
        state: folder of the plants' states, stored as often as the monitor's settings say. A restarted monitor, and one
            that takes a plant over with the same folder, resumes from it. None: nothing is stored.
        false_alarms_per_day: number of false alarms a day of all plants together; each plant has the same share, so it
            holds however the plants depend on each other. None: only each plant's own number is promised.
        most_plants: largest number of plants among which it is divided.
        points: True to publish estimates, chart points and models for every row; each plant then costs as much as in a
            monitor of its own.
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
            sharding.parse_shard(self.shard)
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

    def share_promise(self, config: MonitorConfig) -> MonitorConfig:
        """Settings of a plant's monitor with its share of the false alarms, or its own number where that is smaller."""
        shares = [item for item in (self.share_per_30_days, config.false_alarms_per_30_days) if item is not None]
        return msgspec.structs.replace(config, false_alarms_per_30_days=min(shares, default=None))
