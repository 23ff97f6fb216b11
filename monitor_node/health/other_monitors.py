"""Other monitors of the same plants, found by their liveliness tokens.

Two monitors of one plant raise every alarm twice, and both answer commands. Monitors that divide plants among
themselves are one group: the shards of a fleet (see `fleet.sharding`). A monitor of one plant is a group of its own.
Each group is reported once, with the first shared plant, and once more when its last monitor has gone.

>>> own, fleet = keys.monitor_token("a", "01"), keys.fleet_token("0f", "1", "1", keys.fleet_member("02", "reactor/*"))
>>> others = OtherMonitors(own, lambda: ["a"])
>>> others.on_token(own, is_alive=True)
>>> others.on_token(fleet, is_alive=True)
Report(plant='a', other='fleet reactor/* (1 shard)', is_alive=True)
>>> others.on_token(fleet, is_alive=False).is_alive
False
"""

import fnmatch
from collections.abc import Callable, Collection, Iterator
from typing import NamedTuple

import structlog

from reactorwatch.contract import keys

log = structlog.get_logger()

MOST_GROUPS = 1000
"""Largest number of groups; tokens of further ones are ignored, as anyone may declare tokens."""

NOTICED = "another monitor watches this plant; stop one of them, or change which plants it watches"
GONE = "the other monitor of this plant has gone"


class Group(NamedTuple):
    """Monitors that share plants, one monitor a plant.

    Attributes:
        plants: name of a plant; `*` stands for any letters.
        name: name of the group, unique for these plants.
    """

    plants: str
    name: str

    def __str__(self) -> str:
        return self.name


class Report(NamedTuple):
    """Another group with an own plant.

    Attributes:
        plant: the first plant that both monitor.
        other: name of the group.
        is_alive: True when the group was noticed, False when its last monitor has gone.
    """

    plant: str
    other: str
    is_alive: bool


def group_of(token: str) -> Group | None:
    """Group of a liveliness token; None if the token is not a monitor's or does not name its plants."""
    fleet = keys.parse_fleet_token(token)
    if fleet is not None:
        shards = f"{fleet.of} shard{'s' if fleet.of != '1' else ''}"
        plants = fleet.plants
        return Group(plants.removeprefix(f"{keys.ROOT}/"), f"fleet {plants} ({shards})") if plants else None
    topic = keys.parse(token)
    name = token.rpartition("/")[2]
    if topic is None or token != keys.monitor_token(topic.plant, name):
        return None
    return Group(topic.plant, name)


class OtherMonitors:
    """Other groups that monitor this monitor's plants.

    Args:
        own: liveliness token of this monitor.
        plants: returns the plants of this monitor.
    """

    def __init__(self, own: str, plants: Callable[[], Collection[str]]) -> None:
        self._own, self._plants = group_of(own), plants
        self._tokens: dict[Group, set[str]] = {}
        self._named: dict[str, list[Group]] = {}  # groups of one plant, by its name
        self._wide: list[Group] = []  # groups of several plants
        self._reported: dict[Group, str] = {}  # plant by group

    def on_token(self, token: str, *, is_alive: bool) -> Report | None:
        """Update with a liveliness token; returns a report, if there is one."""
        group = group_of(token)
        if group is None or group == self._own:
            return None
        if is_alive:
            return self._add(group, token)
        tokens = self._tokens.get(group, set())
        tokens.discard(token)
        return None if tokens else self._remove(group)

    def check(self, plant: str) -> Iterator[Report]:
        """Report groups that monitor a plant which this monitor has adopted, unless reported."""
        wide = (group for group in self._wide if fnmatch.fnmatchcase(plant, group.plants))
        for group in (*self._named.get(plant, ()), *wide):
            if group not in self._reported:
                yield self._report(group, plant)

    def count(self, plant: str) -> int:
        """Number of other groups that monitor a plant."""
        return len(self._named.get(plant, ())) + sum(fnmatch.fnmatchcase(plant, item.plants) for item in self._wide)

    def _add(self, group: Group, token: str) -> Report | None:
        if group in self._tokens or len(self._tokens) >= MOST_GROUPS:
            self._tokens.get(group, set()).add(token)
            return None
        self._tokens[group] = {token}
        plants = self._plants()
        if "*" in group.plants:
            self._wide.append(group)
            shared = next((plant for plant in plants if fnmatch.fnmatchcase(plant, group.plants)), None)
        else:
            self._named.setdefault(group.plants, []).append(group)
            shared = group.plants if group.plants in plants else None
        return None if shared is None else self._report(group, shared)

    def _remove(self, group: Group) -> Report | None:
        if self._tokens.pop(group, None) is None:
            return None
        groups = self._wide if "*" in group.plants else self._named[group.plants]
        groups.remove(group)
        if not groups:
            self._named.pop(group.plants, None)
        plant = self._reported.pop(group, None)
        return None if plant is None else Report(plant, str(group), False)

    def _report(self, group: Group, plant: str) -> Report:
        self._reported[group] = plant
        return Report(plant, str(group), True)


def log_report(report: Report | None) -> None:
    """Log a report, if there is one: a warning when a group was noticed, an info line when it has gone."""
    if report is not None:
        write, text = (log.warning, NOTICED) if report.is_alive else (log.info, GONE)
        write(text, plant=report.plant, other=report.other)
