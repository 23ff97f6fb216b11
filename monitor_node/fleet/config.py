"""Settings of a fleet."""

import msgspec

from monitor_node.fleet import sharding
from reactorwatch.contract import keys
from reactorwatch.errors import InputError


class FleetConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of a fleet; those of the monitor apply to each of its plants.

    Attributes:
        plants: key expression of the plants, such as `reactor/*`; None: one plant, that of the monitor's settings.
        shard: own shard, such as `2/5`: its plants, and those of shards whose monitors are gone.
        processes: process by plant, a name in the catalogue or a file; a key may be a pattern of plants such as
            `north_*`, and a plant's own entry goes before patterns. Other plants have that of the monitor's settings.
        state: folder of the plants' states, stored as often as the monitor's settings say. A restarted monitor, and one
            that takes a plant over with the same folder, resumes from it. None: nothing is stored.
        points: True to publish estimates, chart points and models for every row; each plant then costs as much as in a
            monitor of its own.
    """

    plants: str | None = None
    shard: str = "1/1"
    processes: dict[str, str] = {}  # msgspec copies the default
    state: str | None = None
    points: bool = False

    def __post_init__(self) -> None:
        if self.plants is not None:
            keys.check_plants(self.plants)
        try:
            sharding.parse_shard(self.shard)
        except InputError as error:
            raise ValueError(str(error)) from error
