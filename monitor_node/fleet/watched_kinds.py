"""Plants of several processes that one monitor of a fleet owns: the plants of each kind are watched together."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import NamedTuple

from monitor_node.baseline.training_diagnosis import DiagnosisJob, Finding
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet.watched_plants import State, WatchedPlants
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.process.model import ProcessModel


class PlantKind(NamedTuple):
    """Plants of one process.

    Attributes:
        pattern: name of a plant, or a pattern of names such as `north_*`.
        config: settings of each plant's monitor.
        model: see `Monitor`.
    """

    pattern: str
    config: MonitorConfig
    model: ProcessModel | None


ANY = "*"
"""Pattern of all plants."""

MAX_CACHED = 100_000
"""Plants whose kind is cached; senders choose the names."""


class WatchedKinds:
    """The plants of one monitor, by kind; each method is that of `WatchedPlants`.

    Args:
        kinds: kinds of plants; a plant is of the first kind that names it, else of the first whose pattern it matches.
            The last kind has the pattern `ANY`.
        start_ns: present time.
        points: see `Monitor`.
        diagnose: see `WatchedPlants`.

    Attributes:
        alarms: names of the alarms of any plant.

    Raises:
        InputError: the settings are inconsistent.
    """

    def __init__(
        self,
        kinds: Sequence[PlantKind],
        start_ns: int,
        *,
        points: bool,
        diagnose: Callable[[str, DiagnosisJob], None] = lambda _plant, _job: None,
    ) -> None:
        self._kinds = [
            WatchedPlants(kind.config, start_ns, kind.model, points=points, diagnose=diagnose) for kind in kinds
        ]
        patterns = [kind.pattern for kind in kinds]
        self.alarms = tuple(dict.fromkeys(alarm for kind in self._kinds for alarm in kind.alarms))

        @lru_cache(maxsize=MAX_CACHED)
        def find(plant: str) -> WatchedPlants:
            exact = patterns.index(plant) if plant in patterns else None
            matching = (index for index, pattern in enumerate(patterns) if fnmatchcase(plant, pattern))
            return self._kinds[next(matching) if exact is None else exact]

        self._find = find

    def __contains__(self, plant: str) -> bool:
        return plant in self._find(plant)

    @property
    def plants(self) -> list[str]:
        """All plants."""
        return [plant for kind in self._kinds for plant in kind.plants]

    @property
    def quiet(self) -> list[str]:
        """The packed plants."""
        return [plant for kind in self._kinds for plant in kind.quiet]

    def prepare(self) -> None:
        """Compile the machine code of the first use."""
        for kind in self._kinds:
            kind.prepare()

    def new_monitor(self, plant: str, now_ns: int) -> Monitor:
        """Make a monitor for a plant."""
        return self._find(plant).new_monitor(plant, now_ns)

    def add(self, plant: str, monitor: Monitor) -> None:
        """Add a plant."""
        self._find(plant).add(plant, monitor)

    def on_finding(self, plant: str, finding: Finding) -> None:
        """Process the diagnosis of a plant's training."""
        self._find(plant).on_finding(plant, finding)

    def remove(self, plant: str) -> Monitor | None:
        """Remove a plant; returns its monitor."""
        return self._find(plant).remove(plant)

    def copy(self, plant: str, name: str) -> None:
        """Add a copy of a quiet plant, for trials with many plants."""
        self._find(plant).copy(plant, name)

    def active_monitor(self, plant: str) -> Monitor | None:
        """Monitor of a plant; None if it is quiet, or there is no such plant."""
        return self._find(plant).active_monitor(plant)

    def detach(self, plant: str) -> Monitor | None:
        """Unpack a plant, if it is quiet; returns its monitor."""
        return self._find(plant).detach(plant)

    def state_of(self, plant: str) -> State:
        """State of a plant."""
        return self._find(plant).state_of(plant)

    def received_count(self, plant: str) -> int | None:
        """Number of messages of a plant; None: there is no such plant."""
        return self._find(plant).received_count(plant)

    def count_not_stored(self, plant: str) -> None:
        """Count a failure to store the state of a plant."""
        self._find(plant).count_not_stored(plant)

    def on_messages(self, messages: list[Encoded], now_ns: int) -> tuple[list[Publication], list[Encoded], set[str]]:
        """Process messages of quiet plants; returns publications, the other messages, and plants unpacked for them."""
        publications: list[Publication] = []
        touched: set[str] = set()
        for kind in self._kinds:
            published, messages, unpacked = kind.on_messages(messages, now_ns)
            publications += published
            touched |= unpacked
        return publications, messages, touched

    def settle(self, plants: Iterable[str]) -> list[str]:
        """Pack plants that are normal now, and schedule the others; returns the packed ones."""
        by_kind: dict[int, list[str]] = {}
        for plant in plants:
            by_kind.setdefault(self._kinds.index(self._find(plant)), []).append(plant)
        return [plant for index, of_kind in by_kind.items() for plant in self._kinds[index].settle(of_kind)]

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Publish health where it is due; raise the alarms of plants without data."""
        return [item for kind in self._kinds for item in kind.on_tick(now_ns)]

    def next_tick_ns(self) -> int:
        """Earliest deadline of the plants."""
        return min(kind.next_tick_ns() for kind in self._kinds)

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Publish the health of all plants' monitors for the last time."""
        return [item for kind in self._kinds for item in kind.on_stop(now_ns)]

    def reports(self, now_ns: int) -> Iterator[tuple[str, str]]:
        """Notes to log: plant and line."""
        for kind in self._kinds:
            yield from kind.reports(now_ns)

    def tracebacks(self) -> Iterator[tuple[str, str]]:
        """Plant and traceback of each contained error that was reported."""
        for kind in self._kinds:
            yield from kind.tracebacks()
