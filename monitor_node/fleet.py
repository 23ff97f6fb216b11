"""Fleet: a dictionary of monitors, one for each plant, its settings, and its division into shards.

A plant is watched from the first liveliness token of one of its nodes but the recorder, which may record all plants, or
from its first sample, if it is in this monitor's shard. Its publications are the same, value for value, as if it were
monitored alone.

Each monitor of a divided fleet has one shard: `2/5` is the second of five. A plant's shard follows from a digest of its
name, the same on every machine and in every version, and never changes.

Nothing here reads a clock or does I/O.
"""

import re
from collections.abc import Callable, Sequence
from fnmatch import fnmatchcase
from hashlib import blake2b
from heapq import heappop, heappush
from itertools import chain
from typing import Annotated, NamedTuple

import msgspec

from monitor_node.causes import stage
from monitor_node.charts import shift_and_drift as drift
from monitor_node.config import LARGEST_FALSE_ALARMS, LEAST_FALSE_ALARMS, MonitorConfig
from monitor_node.core import Monitor
from monitor_node.learn.training_diagnosis import DiagnosisJob, Finding
from monitor_node.watched_process import load_process
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, CommandReply
from reactorwatch.errors import InputError
from reactorwatch.identification.rls import RecursiveLeastSquares
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import NEVER_NS
from reactorwatch.runtime.bus import Node
from reactorwatch.runtime.config import check_bounds
from reactorwatch.spc.false_alarm_budget import DAYS


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
    try:
        return Shard(*keys.parse_shard(text))
    except ValueError as error:
        raise InputError(str(error)) from error


def shard_of(plant: str, of: int) -> int:
    """Number of a plant's shard, from 1.

    >>> [shard_of(plant, 3) for plant in ("a", "b", "c", "d")]
    [3, 3, 1, 3]
    """
    return int.from_bytes(blake2b(plant.encode(), digest_size=8).digest(), "big") % of + 1


_ADDRESS = re.compile(r"(tcp|tls)://([^\s/:\[\]]+|\[[\da-fA-F:.]+\]):[1-9]\d{0,4}")
"""Address of a Dask scheduler."""


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
        shards: number of shards that the command `monitor` places on the workers of a Dask cluster.
        scheduler: address of its scheduler, such as `tls://10.0.0.3:8786`. Where it is set, other machines may use the
            folder of states.
        identity: folder with ca.pem, certificate.pem and key.pem for its connections; in a settings file, the path is
            relative to that file's folder. None: with `tls://` the certificate of the bus.
    """

    plants: str | None = None
    shard: str = "1/1"
    processes: dict[str, str] = {}  # msgspec copies the default
    state: str | None = None
    false_alarms_per_day: Annotated[float, msgspec.Meta(ge=1e-4, le=1e6)] | None = None
    most_plants: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 100
    points: bool = False
    shards: Annotated[int, msgspec.Meta(ge=1, le=1000)] | None = None
    scheduler: str | None = None
    identity: str | None = None

    def __post_init__(self) -> None:
        if self.plants is not None:
            keys.check_plants(self.plants)
        if self.scheduler is not None and _ADDRESS.fullmatch(self.scheduler) is None:
            raise ValueError(
                f"scheduler must be like tls://10.0.0.3:8786 or tcp://127.0.0.1:8786, got {self.scheduler}"
            )
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


EVICT_NS = 600_000_000_000
"""An unverified plant without a message in this time is evicted."""

ANY = "*"
"""Pattern of all plants."""


class PlantKind(NamedTuple):
    """Plants of one process, which share settings and model.

    Attributes:
        pattern: name of a plant, or a pattern of names such as `north_*`.
        config: settings of each plant's monitor; its plant name is ignored.
        model: see `Monitor`.
    """

    pattern: str
    config: MonitorConfig
    model: ProcessModel | None


def load_kinds(config: MonitorConfig, fleet: FleetConfig) -> tuple[PlantKind, ...]:
    """Kinds of plants in a fleet; the last one has the pattern `ANY` and the process of the monitor's settings.

    Raises:
        InputError: a process cannot be loaded, or does not fit the settings of the monitor.
    """
    named = {
        name: load_process(msgspec.structs.replace(config, process=name))
        for name in dict.fromkeys(fleet.processes.values())
    }
    kinds = (PlantKind(pattern, *named[name]) for pattern, name in fleet.processes.items())
    return (*kinds, PlantKind(ANY, *load_process(config)))


def prepare(kinds: Sequence[PlantKind], *, points: bool) -> None:
    """Compile the machine code of the first use, which takes ten seconds and more on a new machine.

    Raises:
        InputError: the settings are inconsistent.
    """
    RecursiveLeastSquares(1).update([1.0], 1.0)
    for kind in kinds:
        model = Monitor(kind.config, 0, points=points, model=kind.model).pipeline.model
        for _ in chain(drift.preparation(kind.config, wanted=points), stage.preparation(kind.config, model)):
            pass


class FleetMonitor(Node):
    """Monitors of many plants.

    A plant is verified by a liveliness token of one of its nodes but the recorder, by a stored state, or by aligned
    rows. Anyone may publish under invented names, so the number of unverified plants is limited, and those that fall
    silent are evicted: invented names use up neither memory nor the capacity for plants with a token.

    Args:
        kinds: kinds of plants, see `load_kinds`. A plant is of the first kind that names it, else of the first whose
            pattern it matches.
        start_ns: present time.
        shard: own shard of the plants.
        points: see `Monitor`.
        passes: exceptions that end the monitor, see `Failures`; by default all of them concern one plant alone.
        on_watch: called with a plant and True when its monitor is added, with False when it is removed.
        diagnose: called with a plant and the diagnosis of its training; the result is passed to `on_finding`.

    Raises:
        InputError: the settings are inconsistent.

    Attributes:
        evictions: number of unverified plants that were evicted.
        is_behind: see `Monitor`.
    """

    def __init__(
        self,
        kinds: Sequence[PlantKind],
        start_ns: int,
        shard: Shard = WHOLE,
        *,
        points: bool = False,
        passes: type[Exception] | tuple[()] = (),
        on_watch: Callable[[str, bool], None] = lambda _plant, _watched: None,
        diagnose: Callable[[str, DiagnosisJob], None] = lambda _plant, _job: None,
    ) -> None:
        for kind in kinds:  # inconsistent settings are refused here
            Monitor(kind.config, start_ns, points=points, model=kind.model)
        self._kinds, self._named = kinds, {kind.pattern: kind for kind in reversed(kinds)}
        self._shard, self._points, self._passes = shard, points, passes
        self._on_watch, self._diagnose = on_watch, diagnose
        self._monitors: dict[str, Monitor] = {}
        self._active_ns: dict[str, int] = {}  # last activity of the unverified plants, the least recent first
        self.evictions = 0
        self._by_key: dict[str, Monitor] = {}  # by key of a sample
        self._foreign: set[str] = set()  # keys of samples of other shards
        self._heap: list[tuple[int, str]] = []  # deadlines; one that was postponed is noticed when it comes up
        self._due_ns: dict[str, int] = {}  # the earliest deadline in the heap by plant
        self._submitted: set[str] = set()  # plants whose training is being diagnosed
        self.is_behind = False

    # --- plants ----------------------------------------------------------------------------------------------

    @property
    def plants(self) -> list[str]:
        """The watched plants."""
        return list(self._monitors)

    def monitor(self, plant: str) -> Monitor:
        """Monitor of a plant.

        Raises:
            InputError: the plant is not watched.
        """
        if plant not in self._monitors:
            raise InputError(f"plant {plant!r} is not watched here (there are: {', '.join(self.plants)})")
        return self._monitors[plant]

    def alarms_of(self, plant: str) -> list[Alarm]:
        """Alarms of a plant; empty if it is not watched."""
        return self._monitors[plant].alarms.all_alarms() if plant in self._monitors else []

    def is_worth_storing(self, plant: str) -> bool:
        """True if a plant is watched, is verified and has rows."""
        own = self._monitors.get(plant)
        return own is not None and own.rows > 0 and plant not in self._active_ns

    def register(
        self, plant: str, now_ns: int, *, verified: bool, restore: Callable[[Monitor], None] | None = None
    ) -> None:
        """Watch a plant, if it is new and in the own shard.

        Args:
            plant: name of the plant.
            now_ns: present time.
            verified: True if the plant certainly exists; a watched plant is verified then.
            restore: called with the plant's new monitor, before it is used.
        """
        if plant in self._monitors:
            if verified:
                self._active_ns.pop(plant, None)
            return
        has_room = len(self._monitors) < 100_000 and (verified or len(self._active_ns) < 1000)
        if not (has_room and self._shard.has(plant) and is_plant(plant)):
            return
        if not verified:
            self._active_ns[plant] = now_ns
        kind = self._named.get(plant) or next(item for item in self._kinds if fnmatchcase(plant, item.pattern))
        config = msgspec.structs.replace(kind.config, plant=plant)
        monitor = self._monitors[plant] = Monitor(config, now_ns, points=self._points, model=kind.model)
        monitor.failures.passes = self._passes
        if restore is not None:
            restore(monitor)
        for signal in (*config.signals, *config.carried_signals):
            self._by_key[keys.key(plant, keys.SAMPLE, signal)] = monitor
        self._schedule(plant, monitor)
        self._on_watch(plant, True)

    def _evict(self, now_ns: int) -> None:
        """Remove the unverified plants without recent messages."""
        while self._active_ns:
            plant, active_ns = next(iter(self._active_ns.items()))
            if now_ns - active_ns < EVICT_NS:
                return
            del self._active_ns[plant]
            self.evictions += 1
            config = self._monitors.pop(plant).config
            for signal in (*config.signals, *config.carried_signals):
                self._by_key.pop(keys.key(plant, keys.SAMPLE, signal), None)
            self._due_ns.pop(plant, None)
            self._submitted.discard(plant)
            self._on_watch(plant, False)

    def on_finding(self, plant: str, finding: Finding) -> None:
        """Process the diagnosis of a plant's training; the plant may have been removed."""
        self._submitted.discard(plant)
        if plant in self._monitors:
            self._monitors[plant].pipeline.baselines.on_finding(finding)

    def _schedule(self, plant: str, monitor: Monitor) -> None:
        """Submit a training for diagnosis, once, and schedule the deadline if it is earlier than the present one."""
        if monitor.pipeline.baselines.update.is_pending and plant not in self._submitted:
            job = monitor.pipeline.baselines.diagnosis_job
            if job is not None:
                self._submitted.add(plant)
                self._diagnose(plant, job)
        due_ns = monitor.next_tick_ns()
        if due_ns < self._due_ns.get(plant, due_ns + 1):
            self._due_ns[plant] = due_ns
            heappush(self._heap, (due_ns, plant))

    # --- event loop ------------------------------------------------------------------------------------------

    def on_alive(self, token: str, is_alive: bool, now_ns: int) -> list[Publication]:
        """Process the liveliness token of a plant's node; a recorder's may be of all plants and show none."""
        topic = keys.parse(token)
        if topic is not None and topic.kind == keys.ALIVE and topic.name != "recorder" and is_alive:
            self.register(topic.plant, now_ns, verified=True)
        return []

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Process a sample of a plant."""
        return self.on_messages([message], now_ns)

    def on_messages(self, messages: list[Encoded], now_ns: int) -> list[Publication]:
        """Process samples, which are in order for each plant."""
        publications: list[Publication] = []
        by_monitor: dict[Monitor, list[Encoded]] = {}  # one plant after the other: its objects stay in the cache
        for message in messages:
            monitor = self._by_key.get(message.key) or self._monitor_of(message.key, now_ns)
            if monitor is not None:
                by_monitor.setdefault(monitor, []).append(message)
        for monitor, own in by_monitor.items():
            publications += monitor.on_messages(own, now_ns)
            plant = monitor.config.plant
            if self._active_ns and self._active_ns.pop(plant, None) is not None and monitor.rows < 32:
                self._active_ns[plant] = now_ns
            self._schedule(plant, monitor)
        return publications

    def _monitor_of(self, key: str, now_ns: int) -> Monitor | None:
        """Monitor for a new key, or for one that is none of its plant's signals; None: the plant is not watched."""
        if key in self._foreign:
            return None
        topic = keys.parse(key)
        if topic is None or topic.kind != keys.SAMPLE:
            return None
        if not self._shard.has(topic.plant):
            # senders choose the names
            if len(self._foreign) < 100_000:
                self._foreign.add(key)
            return None
        self.register(topic.plant, now_ns, verified=False)
        return self._monitors.get(topic.plant)

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply | None, list[Publication]]:
        """Execute an operator's command; None as reply: the plant is not watched here."""
        topic = keys.parse(question.key)
        monitor = None if topic is None else self._monitors.get(topic.plant)
        return (None, []) if monitor is None else monitor.on_command(question, now_ns)

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Publish health where it is due; raise the alarms of plants without data."""
        self._evict(now_ns)
        publications: list[Publication] = []
        while self._heap and self._heap[0][0] <= now_ns:
            due_ns, plant = heappop(self._heap)
            if self._due_ns.get(plant) != due_ns:
                continue
            del self._due_ns[plant]
            monitor = self._monitors[plant]
            if monitor.next_tick_ns() <= now_ns:
                monitor.is_behind = self.is_behind
                publications += monitor.on_tick(now_ns)
            self._schedule(plant, monitor)
        return publications

    def next_tick_ns(self) -> int:
        """Earliest deadline of the plants."""
        return self._heap[0][0] if self._heap else NEVER_NS

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Publish the health of all plants' monitors for the last time."""
        return [item for monitor in self._monitors.values() for item in monitor.on_stop(now_ns)]


def is_plant(name: str) -> bool:
    """True if a plant may have this name."""
    try:
        keys.check_plant(name)
    except ValueError:
        return False
    return True
