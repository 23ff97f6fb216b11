"""The plants that one monitor of a fleet watches, in one of two forms each.

A plant in which nothing happens is with the quiet ones (`quiet`), any other has a monitor of its own, until it is seen
that nothing happens in it any more. What is said is the same.
"""

from collections.abc import Iterable, Iterator

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet.deadline_queue import Dues
from monitor_node.isolation import stage
from monitor_node.quiet.form import QuietForm
from monitor_node.quiet.plants import QuietPlants
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.errors import InputError
from reactorwatch.identification.rls import RecursiveLeastSquares
from reactorwatch.process.model import ProcessModel

LOOK_AGAIN_ROWS = 8
"""After so many rows it is seen again whether a plant is quiet."""

State = bytes
"""All that a monitor remembers of a plant."""


class WatchedPlants:
    """The plants that are watched here.

    Args:
        config: how each is watched; its name of a plant is passed over.
        start_ns: now.
        model: as for `Monitor`.
        points: likewise.

    Attributes:
        alarms: names of those that a plant has.

    Raises:
        InputError: settings that do not fit together.
    """

    def __init__(self, config: MonitorConfig, start_ns: int, model: ProcessModel | None, *, points: bool) -> None:
        self._config, self._model, self._points = config, model, points
        first = Monitor(config, start_ns, points=points, model=model)  # settings that make no monitor are refused now
        self._first_model = first.model
        self.alarms = tuple(alarm.alarm for alarm in first.alarms.all_alarms())
        form = None if points or first.model is None else QuietForm.of(config, first.model)
        self._quiet = None if form is None or first.model is None else QuietPlants(form, config, first.model)
        self._monitors: dict[str, Monitor] = {}  # of those that are not quiet
        self._look_at_row: dict[str, int] = {}  # of them: when to see whether it is quiet
        self._dues = Dues()
        self._notes: list[tuple[str, str]] = []

    def __contains__(self, plant: str) -> bool:
        return plant in self._monitors or self._is_quiet(plant)

    @property
    def plants(self) -> list[str]:
        """All of them."""
        return [*self._monitors, *self.quiet]

    @property
    def quiet(self) -> list[str]:
        """Those in which nothing happens just now."""
        return [] if self._quiet is None else self._quiet.plants

    def prepare(self) -> None:
        """Have the machine code made that is made at its first use.

        On a new machine that takes ten seconds and more, and would come while plants wait to be judged: the other
        monitors of the fleet would take us for gone.
        """
        RecursiveLeastSquares(1).update([1.0], 1.0)
        for _ in stage.preparation(self._config, self._first_model):
            pass
        if self._quiet is not None:
            self._quiet.prepare()

    # --- coming and going ------------------------------------------------------------------------------------

    def unwatched(self, plant: str, now_ns: int) -> Monitor:
        """A new monitor of a plant, which is not among these yet."""
        named = msgspec.structs.replace(self._config, plant=plant)
        monitor = Monitor(named, now_ns, points=self._points, model=self._model)
        monitor.failures.passes = ()
        return monitor

    def add(self, plant: str, monitor: Monitor) -> None:
        """Watch a plant."""
        self._monitors[plant] = monitor
        self._dues.note(plant, monitor.next_tick_ns())

    def remove(self, plant: str) -> Monitor | None:
        """Watch a plant no longer; returns its monitor. None: it was not watched."""
        monitor = self.alone(plant)
        if monitor is not None:
            self._forget(plant)
        return monitor

    def copy(self, plant: str, name: str) -> None:
        """Watch another plant that is, so far, like a quiet one: for trials with many plants."""
        assert self._quiet is not None
        self._quiet.copied(plant, name)

    # --- one of them -----------------------------------------------------------------------------------------

    def own(self, plant: str) -> Monitor | None:
        """The monitor of a plant; None if it is quiet, or not among these."""
        return self._monitors.get(plant)

    def alone(self, plant: str) -> Monitor | None:
        """The monitor of a plant, which is not quiet from now on; None if it is not among these."""
        if self._quiet is not None and plant in self._quiet:
            self._given(plant, self._quiet.give(plant))
            self._dues.note(plant, self._monitors[plant].next_tick_ns())
        return self._monitors.get(plant)

    def state_of(self, plant: str) -> State:
        """All that is remembered of a plant.

        Raises:
            InputError: it is not among these.
        """
        if self._quiet is not None and plant in self._quiet:
            return self._quiet.state_of(plant)
        if plant not in self._monitors:
            raise InputError(f"plant {plant!r} is not watched here (there are: {', '.join(self.plants)})")
        return self._monitors[plant].to_bytes()

    def received_of(self, plant: str) -> int | None:
        """How many messages of a plant came; None: it is not among these."""
        if self._quiet is not None and plant in self._quiet:
            return self._quiet.received_of(plant)
        monitor = self._monitors.get(plant)
        return None if monitor is None else monitor.received

    def not_stored(self, plant: str) -> None:
        """Count that what is remembered of a plant could not be stored."""
        if self._quiet is not None and plant in self._quiet:
            self._quiet.not_stored(plant)
        elif (monitor := self._monitors.get(plant)) is not None:
            monitor.not_stored += 1

    # --- samples, and the clock ------------------------------------------------------------------------------

    def on_messages(self, messages: list[Encoded], now_ns: int) -> tuple[list[Publication], list[Encoded], set[str]]:
        """Let the quiet plants judge; returns what is to be said, the other messages, and plants not quiet any more.

        These are to be told to `touched` when they have judged the other messages, too.
        """
        if not self._quiet:
            return [], messages, set()
        publications, others, given = self._quiet.on_messages(messages, now_ns)
        for plant, monitor in given.items():
            self._given(plant, monitor)
        return publications, others, set(given)

    def touched(self, plants: Iterable[str]) -> list[str]:
        """See which of the plants with a monitor of their own are quiet now, and when the others are due.

        Returns:
            Those that are quiet now.
        """
        quiet: list[str] = []
        for plant in plants:
            monitor = self._monitors[plant]
            if self._becomes_quiet(plant, monitor):
                quiet.append(plant)
            else:
                self._dues.note(plant, monitor.next_tick_ns())
        return quiet

    def on_tick(self, now_ns: int) -> list[Publication]:
        """The health of the plants' monitors where it is due, and silences of plants."""
        publications: list[Publication] = []
        if self._quiet:
            for plant in self._quiet.overdue(now_ns):
                self.alone(plant)
            publications += self._quiet.healths(now_ns)
        for plant in self._dues.taken(now_ns):
            monitor = self._monitors.get(plant)
            if monitor is not None:
                if monitor.next_tick_ns() <= now_ns:
                    publications += monitor.on_tick(now_ns)
                self._dues.note(plant, monitor.next_tick_ns())
        return publications

    def next_tick_ns(self) -> int:
        """When the first of the plants is due."""
        due_ns = self._dues.first_ns()
        return min(due_ns, self._quiet.next_due_ns()) if self._quiet else due_ns

    def on_stop(self, now_ns: int) -> list[Publication]:
        """The health of all for the last time."""
        said = [item for monitor in self._monitors.values() for item in monitor.on_stop(now_ns)]
        return said + (self._quiet.last_healths(now_ns) if self._quiet else [])

    def reports(self, now_ns: int) -> Iterator[tuple[str, str]]:
        """What people are to be told: plant and line."""
        yield from self._notes
        self._notes.clear()
        for plant, monitor in self._monitors.items():
            refused = monitor.refusals.report(now_ns)
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

    def _is_quiet(self, plant: str) -> bool:
        return self._quiet is not None and plant in self._quiet

    def _given(self, plant: str, monitor: Monitor) -> None:
        """A quiet plant has a monitor of its own from now on."""
        self._monitors[plant] = monitor
        self._look_at_row[plant] = monitor.rows + LOOK_AGAIN_ROWS

    def _forget(self, plant: str) -> None:
        """A plant has no monitor of its own any more."""
        del self._monitors[plant]
        self._look_at_row.pop(plant, None)
        self._dues.forget(plant)

    def _becomes_quiet(self, plant: str, monitor: Monitor) -> bool:
        """Hold a plant with the quiet ones, if it is one; whether it is."""
        if self._quiet is None or monitor.rows < self._look_at_row.get(plant, 0):
            return False
        self._look_at_row[plant] = monitor.rows + LOOK_AGAIN_ROWS
        try:
            if not self._quiet.take(plant, monitor):
                return False
        except Exception as error:  # noqa: BLE001 # the plant's border: an error here ends neither node nor fleet
            monitor.failures.add("demotion", error, "the plant keeps a monitor of its own")
            return False
        self._notes += [(plant, note) for note in monitor.notes]
        self._forget(plant)
        return True
