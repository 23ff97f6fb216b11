"""The settings of a fleet: which plants one monitor watches."""

import msgspec

from monitor_node.fleet import sharding
from reactorwatch.contract import keys
from reactorwatch.errors import InputError


class FleetConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which plants are watched; how, the settings of the monitor say, the same for all.

    Attributes:
        plants: their key expression, such as `reactor/*`; None: one plant, that of the monitor's settings.
        shard: which part of them is ours, such as `2/5`; its plants, and those of shards that are gone.
        state: folder where all that is remembered of each plant is kept, as often as the settings of the monitor say;
            it is gone on from after a restart, and by who takes the plant over if he has the same one. None: nowhere.
        points: whether estimates, points of charts and models are published for every row; each plant then costs as
            much as in a monitor of its own.
    """

    plants: str | None = None
    shard: str = "1/1"
    state: str | None = None
    points: bool = False

    def __post_init__(self) -> None:
        if self.plants is not None:
            keys.check_plants(self.plants)
        try:
            sharding.parsed(self.shard)
        except InputError as error:
            raise ValueError(str(error)) from error
