"""The plants that one monitor of a fleet owns, each in one of two forms.

A plant in its normal state is packed (`packed`), with the others of its kind; any other has an active monitor, until it
is normal again. Publications are the same.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain

import msgspec

from monitor_node.baseline.training_diagnosis import DiagnosisJob, Finding
from monitor_node.core import Monitor
from monitor_node.fleet.deadline_queue import DeadlineQueue
from monitor_node.fleet.packed.conversion import Conversion
from monitor_node.fleet.packed.plants import PackedPlants
from monitor_node.fleet.plant_kinds import PlantKind, kind_finder
from monitor_node.isolation import stage
from monitor_node.stages import drift
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.errors import InputError
from reactorwatch.identification.rls import RecursiveLeastSquares

DEMOTE_EVERY_ROWS = 8
"""Rows between two attempts to pack a plant."""

State = bytes
"""State of a plant's monitor, serialized."""


class WatchedPlants:
    """The plants of one monitor.

    Args:
        kinds: kinds of plants; the last one has the pattern `plant_kinds.ANY`.
        start_ns: present time.
        points: see `Monitor`.
        diagnose: called with a plant and the diagnosis of its training; the result is passed to `on_finding`.

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
        self._kinds, self._points, self._find = kinds, points, kind_finder(kinds)
        self._diagnose = diagnose
        self._submitted: set[str] = set()  # plants whose training is being diagnosed
        # Inconsistent settings are refused here.
        first = [Monitor(kind.config, start_ns, points=points, model=kind.model) for kind in kinds]
        self._models = [monitor.model for monitor in first]
        self.alarms = tuple(dict.fromkeys(alarm.alarm for monitor in first for alarm in monitor.alarms.all_alarms()))
        self._packed = [None if points else _packed_form(monitor) for monitor in first]  # by kind; None: never packed
        self._monitors: dict[str, Monitor] = {}  # of plants that are not quiet
        self._demote_at_row: dict[str, int] = {}  # row of the next attempt to pack
        self._deadlines = DeadlineQueue()
        self._notes: list[tuple[str, str]] = []

    def __contains__(self, plant: str) -> bool:
        return plant in self._monitors or self._quiet_with(plant) is not None

    @property
    def plants(self) -> list[str]:
        """All plants."""
        return [*self._monitors, *self.quiet]

    @property
    def quiet(self) -> list[str]:
        """The packed plants."""
        return [plant for packed in self._quiet_kinds for plant in packed.plants]

    def prepare(self) -> None:
        """Compile the machine code of the first use.

        On a new machine that takes ten seconds and more. Later it would stall the evaluation, and the other monitors of
        the fleet would presume this one gone.
        """
        RecursiveLeastSquares(1).update([1.0], 1.0)
        for kind, model in zip(self._kinds, self._models, strict=True):
            drifts = drift.preparation(kind.config, wanted=self._points)
            for _ in chain(drifts, stage.preparation(kind.config, model)):
                pass
        for packed in self._packed:
            if packed is not None:
                packed.prepare()

    # --- plants ----------------------------------------------------------------------------------------------

    def new_monitor(self, plant: str, now_ns: int) -> Monitor:
        """Make a monitor for a plant; `add` adds it."""
        kind = self._kinds[self._find(plant)]
        named = msgspec.structs.replace(kind.config, plant=plant)
        monitor = Monitor(named, now_ns, points=self._points, model=kind.model)
        monitor.failures.passes = ()
        return monitor

    def add(self, plant: str, monitor: Monitor) -> None:
        """Add a plant."""
        self._monitors[plant] = monitor
        self._submit(plant, monitor)
        self._deadlines.schedule(plant, monitor.next_tick_ns())

    def on_finding(self, plant: str, finding: Finding) -> None:
        """Process the diagnosis of a plant's training; the plant may have been removed."""
        self._submitted.discard(plant)
        monitor = self.detach(plant)
        if monitor is not None:
            monitor.on_finding(finding)

    def _submit(self, plant: str, monitor: Monitor) -> None:
        """Submit the training of a plant for diagnosis, once."""
        if monitor.awaits_diagnosis and plant not in self._submitted and (job := monitor.diagnosis_job) is not None:
            self._submitted.add(plant)
            self._diagnose(plant, job)

    def remove(self, plant: str) -> Monitor | None:
        """Remove a plant; returns its monitor. None: there is no such plant."""
        monitor = self.detach(plant)
        if monitor is not None:
            self._forget(plant)
            self._submitted.discard(plant)
        return monitor

    def active_monitor(self, plant: str) -> Monitor | None:
        """Monitor of a plant; None if it is quiet, or there is no such plant."""
        return self._monitors.get(plant)

    def detach(self, plant: str) -> Monitor | None:
        """Unpack a plant, if it is quiet; returns its monitor. None: there is no such plant."""
        packed = self._quiet_with(plant)
        if packed is not None:
            self._add_detached(plant, packed.give(plant))
            self._deadlines.schedule(plant, self._monitors[plant].next_tick_ns())
        return self._monitors.get(plant)

    def state_of(self, plant: str) -> State:
        """State of a plant.

        Raises:
            InputError: there is no such plant.
        """
        packed = self._quiet_with(plant)
        if packed is not None:
            return packed.state_of(plant)
        if plant not in self._monitors:
            raise InputError(f"plant {plant!r} is not watched here (there are: {', '.join(self.plants)})")
        return self._monitors[plant].to_bytes()

    def received_count(self, plant: str) -> int | None:
        """Number of messages of a plant; None: there is no such plant."""
        packed = self._quiet_with(plant)
        if packed is not None:
            return packed.received_count(plant)
        monitor = self._monitors.get(plant)
        return None if monitor is None else monitor.memory.received

    def count_not_stored(self, plant: str) -> None:
        """Count a failure to store the state of a plant."""
        packed = self._quiet_with(plant)
        if packed is not None:
            packed.count_not_stored(plant)
        elif (monitor := self._monitors.get(plant)) is not None:
            monitor.stats.not_stored += 1

    # --- event loop ------------------------------------------------------------------------------------------

    def on_messages(self, messages: list[Encoded], now_ns: int) -> tuple[list[Publication], list[Encoded], set[str]]:
        """Process messages of quiet plants; returns publications, the other messages, and plants unpacked for them.

        These plants are passed to `settle` after the other messages.
        """
        publications: list[Publication] = []
        touched: set[str] = set()
        for packed in self._quiet_kinds:
            published, messages, given = packed.on_messages(messages, now_ns)
            publications += published
            touched.update(given)
            for plant, monitor in given.items():
                self._add_detached(plant, monitor)
        return publications, messages, touched

    def settle(self, plants: Iterable[str]) -> list[str]:
        """Pack plants that are normal now, and schedule the others; returns the packed ones."""
        quiet: list[str] = []
        for plant in plants:
            monitor = self._monitors[plant]
            self._submit(plant, monitor)
            if self._demote(plant, monitor):
                quiet.append(plant)
            else:
                self._deadlines.schedule(plant, monitor.next_tick_ns())
        return quiet

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Publish health where it is due; raise the alarms of plants without data."""
        publications: list[Publication] = []
        for packed in self._quiet_kinds:
            for plant in packed.overdue(now_ns):
                self.detach(plant)
            publications += packed.healths(now_ns)
        for plant in self._deadlines.pop_due(now_ns):
            monitor = self._monitors.get(plant)
            if monitor is not None:
                if monitor.next_tick_ns() <= now_ns:
                    publications += monitor.on_tick(now_ns)
                self._deadlines.schedule(plant, monitor.next_tick_ns())
        return publications

    def next_tick_ns(self) -> int:
        """Earliest deadline of the plants."""
        return min((self._deadlines.next_ns(), *(packed.next_due_ns() for packed in self._quiet_kinds)))

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Publish the health of all plants' monitors for the last time."""
        publications = [item for monitor in self._monitors.values() for item in monitor.on_stop(now_ns)]
        return publications + [item for packed in self._quiet_kinds for item in packed.last_healths(now_ns)]

    def reports(self, now_ns: int) -> Iterator[tuple[str, str]]:
        """Notes to log: plant and line."""
        yield from self._notes
        self._notes.clear()
        for plant, monitor in self._monitors.items():
            refused = monitor.rejects.report(now_ns)
            if refused is not None:
                yield plant, refused
            while monitor.notes:
                yield plant, monitor.notes.pop(0)

    def tracebacks(self) -> Iterator[tuple[str, str]]:
        """Plant and traceback of each contained error that was reported."""
        for plant, monitor in self._monitors.items():
            while monitor.failures.tracebacks:
                yield plant, monitor.failures.tracebacks.pop(0)

    # --- within ----------------------------------------------------------------------------------------------

    @property
    def _quiet_kinds(self) -> list[PackedPlants]:
        """Packed plants of the kinds that have any."""
        return [packed for packed in self._packed if packed]

    def _quiet_with(self, plant: str) -> PackedPlants | None:
        """The packed plants with this one; None if it is not packed."""
        packed = self._packed[self._find(plant)]
        return packed if packed is not None and plant in packed else None

    def _add_detached(self, plant: str, monitor: Monitor) -> None:
        """Add the monitor of an unpacked plant."""
        self._monitors[plant] = monitor
        self._demote_at_row[plant] = monitor.rows + DEMOTE_EVERY_ROWS

    def _forget(self, plant: str) -> None:
        """Remove the monitor of a plant."""
        del self._monitors[plant]
        self._demote_at_row.pop(plant, None)
        self._deadlines.remove(plant)

    def _demote(self, plant: str, monitor: Monitor) -> bool:
        """Pack a plant, if it is normal; returns True if it is."""
        packed = self._packed[self._find(plant)]
        if packed is None or monitor.rows < self._demote_at_row.get(plant, 0):
            return False
        self._demote_at_row[plant] = monitor.rows + DEMOTE_EVERY_ROWS
        try:
            if not packed.take(plant, monitor):
                return False
        except Exception as error:  # noqa: BLE001 # the plant's border: an error here ends neither node nor fleet
            monitor.failures.add("demotion", error, "the plant keeps a monitor of its own")
            return False
        self._notes += [(plant, note) for note in monitor.notes]
        self._forget(plant)
        return True


def _packed_form(monitor: Monitor) -> PackedPlants | None:
    """Packed form of plants with the settings of a monitor; None if they cannot be packed."""
    config, model = monitor.config, monitor.model
    if model is None or model.uncertain:  # then plants differ in what was learned
        return None
    form = Conversion.of(config, model)
    return None if form is None else PackedPlants(form, config, model)
