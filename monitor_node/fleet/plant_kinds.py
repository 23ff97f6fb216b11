"""Kinds of plants in a fleet: the plants of one process, each with the same settings of its monitor."""

from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import NamedTuple

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.fleet.config import FleetConfig
from monitor_node.watched_process import load_process
from reactorwatch.process.model import ProcessModel

ANY = "*"
"""Pattern of all plants."""

MAX_CACHED = 100_000
"""Plants whose kind is cached; senders choose the names."""


class PlantKind(NamedTuple):
    """Plants of one process.

    Attributes:
        pattern: name of a plant, or a pattern of names such as `north_*`.
        config: settings of each plant's monitor; its plant name is ignored.
        model: see `Monitor`.
    """

    pattern: str
    config: MonitorConfig
    model: ProcessModel | None


def load_kinds(config: MonitorConfig, fleet: FleetConfig) -> tuple[PlantKind, ...]:
    """Plants whose process the settings of the fleet name.

    Args:
        config: settings of each plant's monitor.
        fleet: settings of the fleet.

    Raises:
        InputError: a process cannot be loaded, or does not fit the settings of the monitor.
    """
    watched = {
        name: load_process(msgspec.structs.replace(config, process=name))
        for name in dict.fromkeys(fleet.processes.values())
    }
    return tuple(PlantKind(pattern, *watched[name]) for pattern, name in fleet.processes.items())


def kind_finder(kinds: Sequence[PlantKind]) -> Callable[[str], int]:
    """Make the function from a plant to the index of its kind.

    A plant is of the first kind that names it, else of the first whose pattern it matches.

    Args:
        kinds: the kinds; the last one has the pattern `ANY`.
    """
    patterns = [kind.pattern for kind in kinds]

    @lru_cache(maxsize=MAX_CACHED)
    def find(plant: str) -> int:
        if plant in patterns:
            return patterns.index(plant)
        return next(index for index, pattern in enumerate(patterns) if fnmatchcase(plant, pattern))

    return find
