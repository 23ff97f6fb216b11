"""Health of a monitor: statistics by receive time, contained errors of this software, other monitors of its plants."""

import fnmatch
import traceback
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import NamedTuple

import structlog

from reactorwatch.contract import keys
from reactorwatch.errors import InputError

log = structlog.get_logger()

NODE = "monitor"

HEARD_AGAIN_NS = 1_000_000
"""Samples closer together than this count as one: the signals of a row arrive together."""

STALL_NS = 1_000_000_000
"""Due work is done within a millisecond; a monitor this late was stalled, or its clock was set."""

MOST_GROUPS = 1000
"""Largest number of groups; tokens of further ones are ignored, as anyone may declare tokens."""

NOTICED = "another monitor watches this plant; stop one of them, or change which plants it watches"
GONE = "the other monitor of this plant has gone"


@dataclass(slots=True)
class ReceiveStats:
    """Statistics of a monitor's messages by receive time. A restart resets them.

    Attributes:
        start_ns: start of the monitor.
        health_due_ns: time of the next health message.
        heard_ns: receive time of the newest sample that counted, see `HEARD_AGAIN_NS`.
        lag_ns: longest delay of a message since the last health message.
        ticked: True if there was a tick before.
        stalls: number of ticks that were more than a second late.
        not_stored: number of failures to store the state, counted by the storage.
    """

    start_ns: int
    health_due_ns: int
    heard_ns: int = 0
    lag_ns: int = 0
    ticked: bool = False
    stalls: int = 0
    not_stored: int = 0


@dataclass
class Failures:
    """Errors of this software in the work on one plant: contained at the plant's border, counted, and reported once.

    A monitor must survive its own errors, and a plant of a fleet those of another. So an exception in a stage is caught
    where the work on a plant starts. It costs that plant the stage's state, and is reported once for each line of code
    that raises it.

    Attributes:
        by_stage: number of exceptions since the plant was first watched, by stage.
        notes: notes to log, oldest first; the caller empties the list.
        tracebacks: tracebacks of the same exceptions, oldest first; the caller empties the list.
        passes: exceptions that are not contained. In the monitor of one plant these are impossible settings, which its
            user must see; in a fleet they concern one plant, and are contained.
    """

    by_stage: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    tracebacks: list[str] = field(default_factory=list)
    passes: type[Exception] | tuple[()] = InputError
    _reported: set[str] = field(default_factory=set)

    def add(self, stage: str, error: Exception, cost: str) -> None:
        """Count an exception, and report it if it is the first from its line of code.

        Raises:
            Exception: the exception, if it passes.
        """
        if isinstance(error, self.passes):
            raise error
        self.by_stage[stage] = self.by_stage.get(stage, 0) + 1
        frame = traceback.extract_tb(error.__traceback__)[-1]
        origin = f"{type(error).__name__} in {frame.name}, line {frame.lineno} of {frame.filename.rsplit('/', 1)[-1]}"
        if origin in self._reported:
            return
        self._reported.add(origin)
        cause = " ".join(str(error).split())[:300]
        self.notes.append(f"error of this software in the stage {stage}: {origin}: {cause}; {cost}; please report it")
        self.tracebacks.append("".join(traceback.format_exception(error)))


class Group(NamedTuple):
    """Monitors that share plants, one monitor a plant: the shards of a fleet, or the monitor of one plant.

    Attributes:
        plants: name of a plant; `*` stands for any letters.
        name: name of the group, unique for these plants.
    """

    plants: str
    name: str

    def includes(self, plant: str) -> bool:
        """True if the group monitors a plant."""
        return plant == self.plants or ("*" in self.plants and fnmatch.fnmatchcase(plant, self.plants))


def group_of(token: str) -> Group | None:
    """Group of a liveliness token; None if the token is not a monitor's or does not name its plants."""
    fleet = keys.parse_fleet_token(token)
    if fleet is not None:
        shards = f"{fleet.of} shard{'s' if fleet.of != '1' else ''}"
        return Group(fleet.plants.removeprefix(f"{keys.ROOT}/"), f"fleet {fleet.plants} ({shards})")
    topic, name = keys.parse(token), token.rpartition("/")[2]
    if topic is None or token != keys.monitor_token(topic.plant, name):
        return None
    return Group(topic.plant, name)


class OtherMonitors:
    """Other groups that monitor this monitor's plants, found by their liveliness tokens.

    Two monitors of one plant raise every alarm twice, and both answer commands. Each group is logged once, with the
    first shared plant, and once more when its last monitor has gone.
    """

    def __init__(self, own: str, plants: Callable[[], Collection[str]]) -> None:
        self._own, self._plants = group_of(own), plants
        self._tokens: dict[Group, set[str]] = {}
        self._reported: dict[Group, str] = {}  # plant by group

    def on_token(self, token: str, *, is_alive: bool) -> None:
        """Update with a liveliness token."""
        group = group_of(token)
        if group is None or group == self._own or (group not in self._tokens and len(self._tokens) >= MOST_GROUPS):
            return
        if is_alive:
            self._tokens.setdefault(group, set()).add(token)
            self._report(group, self._plants())
        elif group in self._tokens:
            self._tokens[group].discard(token)
            if not self._tokens[group]:
                del self._tokens[group]
                if group in self._reported:
                    log.info(GONE, plant=self._reported.pop(group), other=group.name)

    def check(self, plant: str) -> None:
        """Log groups that monitor a plant which this monitor has begun to watch, unless logged."""
        for group in self._tokens:
            self._report(group, (plant,))

    def count(self, plant: str) -> int:
        """Number of other groups that monitor a plant."""
        return sum(group.includes(plant) for group in self._tokens)

    def _report(self, group: Group, plants: Collection[str]) -> None:
        shared = None if group in self._reported else next(filter(group.includes, plants), None)
        if shared is not None:
            self._reported[group] = shared
            log.warning(NOTICED, plant=shared, other=group.name)
