"""The watch over a fleet: any set of plants in one process, each with a state of its own.

A plant is known from the moment when one of its nodes shows a liveliness token, or a sample of it comes. Whether it is
ours to watch is the crew's question (see `shards`): one monitor watches all, or several share them, and take over from
each other. What a plant's monitor says is the same, value for value, as if it were watched alone.

Who takes a plant over, because the monitor that watched it is gone, asks for its past: the state that was stored, if
there is one, and what the plant still remembers to have said (`on_past`). With a state, what the other had already said
is left out when it is found again, so that no alarm is told twice. Without one the plant is learned anew, but its
alarms are not forgotten: monitors of a fleet hear each other's alarms, so one that stands is not raised again, and it
is cleared when it is over.

While others may have taken over from ourselves nothing is judged (`hold`), until it is known of which plants they have
(`go_on`). Of those we go on from what they know.

Nothing here reads a clock or does I/O.
"""

from collections.abc import Callable, Iterable, Iterator

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet.admission import PROVEN_MESSAGES, PROVEN_ROWS, Strangers
from monitor_node.fleet.deadline_queue import NEVER_NS
from monitor_node.fleet.handed_over_alarms import AlarmsBefore, alarm_of
from monitor_node.fleet.recently_adopted import Recent
from monitor_node.fleet.sharding import Crew
from monitor_node.fleet.watched_plants import State, WatchedPlants
from monitor_node.ingest.pending import Arrivals, Past, cut
from monitor_node.replay.recorded_sessions import SILENCE
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, CommandReply
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel

PATIENCE_NS = 10_000_000_000
"""After the start: a shard of which nobody was seen by then is taken for gone."""

MOST_PLANTS = 100_000

MOST_HELD = 500_000
"""Messages that wait until it is known whose the plants are; with more they are judged, as late is worse than twice."""


class FleetMonitor:
    """The monitors of many plants.

    Args:
        config: how each plant is watched; its name of a plant is passed over.
        start_ns: now.
        crew: who else watches plants of the fleet.
        model: as for `Monitor`.
        points: as for `Monitor`.
        ask_past: told a plant that is to be watched from now on, and whether another watched it until now; whether its
            past will be told by `on_past`. If not, the plant is watched at once.
        store: told the state of a plant that is another's from now on.
        unusable: told a plant with a state that it cannot go on from, and why; returns what became of the state.
        put_back: given a plant without a state that can be used, and its new monitor; returns whether the monitor was
            restored from a state that had been kept aside.
        in_charge: told when we begin to watch a plant (True), and when it is another's (False).

    Raises:
        InputError: settings that do not fit together.
    """

    def __init__(
        self,
        config: MonitorConfig,
        start_ns: int,
        crew: Crew,
        *,
        model: ProcessModel | None = None,
        points: bool = False,
        ask_past: Callable[[str, bool], bool] = lambda _plant, _taken_over: False,
        store: Callable[[str, State], None] = lambda _plant, _state: None,
        unusable: Callable[[str, InputError], str] = lambda _plant, _why: "",
        put_back: Callable[[str, Monitor], bool] = lambda _plant, _monitor: False,
        in_charge: Callable[[str, bool], None] = lambda _plant, _ours: None,
    ) -> None:
        self._crew, self._in_charge = crew, in_charge
        self._ask_past, self._store, self._unusable = ask_past, store, unusable
        self._put_back = put_back
        self._here = WatchedPlants(config, start_ns, model, points=points)
        self._arrivals = Arrivals()
        self._patience_ns: int | None = start_ns + PATIENCE_NS
        self._met: dict[str, None] = {}  # all plants that are known, whoever watches them
        self._strangers = Strangers()
        self._signals = (config.input, *config.outputs)
        self._plants: dict[str, str] = {}  # by key of a sample, those that are not quiet
        self._before, self._recent = AlarmsBefore(self._here.alarms), Recent()
        self._held: list[Encoded] | None = None  # what came while it is not known whose the plants are

    # --- who is watched --------------------------------------------------------------------------------------

    @property
    def plants(self) -> list[str]:
        """Those that are watched here."""
        return self._here.plants

    @property
    def quiet(self) -> list[str]:
        """Those of them in which nothing happens just now."""
        return self._here.quiet

    def on_alive(self, token: str, is_alive: bool, now_ns: int) -> list[Publication]:
        """A node of a plant, or another monitor of the fleet, came or went."""
        topic = keys.parse(token)
        if self._crew.note(token, is_alive=is_alive):
            self._share_out(now_ns)
        elif topic is not None and topic.kind == keys.ALIVE and is_alive:
            self.meet(topic.plant, now_ns, vouched=True)
        return []

    def on_past(self, past: Past, now_ns: int) -> list[Publication]:
        """Begin to watch a plant whose past was asked for, if it is still ours: judge that, and what came since."""
        if past.plant not in self._arrivals:
            return []
        if past.state is not None:
            self._strangers.vouch(past.plant)
        messages = self._arrivals.end(past.plant, past.messages)
        self.adopt(past.plant, past.state, now_ns)
        monitor = self.monitor(past.plant)
        said = self._before.new([item for message in messages for item in monitor.on_message(message, now_ns)])
        self._note_silence(past.plant, monitor)
        monitor.caught_up()
        self._recent.adopted(past.plant, monitor, now_ns)
        self._before.passed(past.plant)
        return said

    def adopt(self, plant: str, state: State | None, now_ns: int) -> None:
        """Begin to watch a plant.

        Args:
            plant: its name.
            state: of the monitor that watched it before, as `Monitor.to_bytes` gives it; None: the plant is learned
                anew. One that cannot be used is noted, and counts as none.
            now_ns: now.
        """
        monitor = self._here.unwatched(plant, now_ns)
        unusable = kept = ""
        if state is not None:
            try:
                monitor.from_bytes(state)
            except InputError as error:
                kept = self._unusable(plant, error)
                unusable, state = f"the state that was stored {error}", None
        if state is None and not self._put_back(plant, monitor):
            monitor.go_on_from_alarms(alarm for alarm in self._before.of(plant) if alarm.alarm != SILENCE)
            if unusable:
                monitor.notes.append(f"{unusable}; the plant is learned anew{kept}")
                self._store(plant, monitor.to_bytes())  # or the folder would not name a plant that is watched
        elif unusable:
            monitor.notes.append(f"{unusable}{kept}")
        self._here.add(plant, monitor)
        self._met[plant] = None
        self._in_charge(plant, True)

    def _note_silence(self, plant: str, monitor: Monitor) -> None:
        """Have the next sample end a silence that was said before; rows from before it end none."""
        monitor.go_on_from_alarms(self._before.silences_after(plant, monitor.alarms.alarm(SILENCE).raised_ns))

    def release(self, plant: str) -> State | None:
        """Watch a plant no longer; returns its state, for who does. None: it was not watched here."""
        monitor = self._here.remove(plant)
        if monitor is None:
            return None
        self._in_charge(plant, False)
        return monitor.to_bytes()

    def rejoin(self, plant: str, now_ns: int) -> None:
        """Another watches a plant that is watched here, or did meanwhile: go on from what he knows, if it is ours."""
        monitor = self._here.remove(plant)
        if monitor is None:
            return
        self._before.we_said(plant, monitor.alarms.all_alarms(), monitor.last_ns)
        self._in_charge(plant, False)
        if self._crew.is_ours(plant):
            self._arrive(plant, now_ns, taken_over=True)

    def hold(self) -> None:
        """Judge nothing until it is known whose the plants are."""
        self._held = [] if self._held is None else self._held

    @property
    def holds(self) -> bool:
        """Whether nothing is judged just now."""
        return self._held is not None

    def go_on(self, others: Iterable[str], now_ns: int) -> list[Publication]:
        """Judge what came meanwhile, and what comes.

        Args:
            others: plants of ours that others have watched meanwhile, as far as that is known; who has told alarms of
                one has, too.
            now_ns: now.
        """
        held, self._held = self._held or [], None
        for plant in {*others, *self._told_by_others(held)}:
            self.rejoin(plant, now_ns)
        return self._judged(held, now_ns)

    def _told_by_others(self, messages: Iterable[Encoded]) -> set[str]:
        """Plants of ours of which alarms were told of rows that we have not judged."""
        found = set()
        for message in messages:
            topic = keys.parse(message.key)
            if topic is None or topic.kind != keys.ALARM:
                continue
            alarm, own = alarm_of(message), self._here.alone(topic.plant)
            if alarm is not None and own is not None and alarm.time_ns > (own.last_ns or 0):
                found.add(topic.plant)
        return found

    def monitor(self, plant: str) -> Monitor:
        """The monitor of a plant.

        Raises:
            InputError: it is not watched here.
        """
        monitor = self._here.alone(plant)
        if monitor is None:
            raise InputError(f"plant {plant!r} is not watched here (there are: {', '.join(self.plants)})")
        return monitor

    def is_watched(self, plant: str) -> bool:
        """True if a plant is watched here."""
        return plant in self._here

    def own(self, plant: str) -> Monitor | None:
        """The monitor of a plant; None if it is quiet, or not watched here."""
        return self._here.own(plant)

    def state_of(self, plant: str) -> State:
        """All that is remembered of a plant that is watched here."""
        return self._here.state_of(plant)

    def alarms_of(self, plant: str) -> list[Alarm] | None:
        """The alarms of a plant; None if they are as they were when it last had a monitor of its own."""
        own = self._here.own(plant)
        return None if own is None else own.alarms.all_alarms()

    def is_worth_storing(self, plant: str) -> bool:
        """Whether anything is known of a plant that is watched here, and it is certain that there is such a plant."""
        own = self._here.own(plant)
        return plant not in self._strangers and (own is None or own.rows > 0)

    @property
    def forgotten(self) -> int:
        """How many plants were forgotten that nobody vouched for, and that said nothing any more."""
        return self._strangers.forgotten

    def received_of(self, plant: str) -> int | None:
        """How many messages of a plant came; None: it is not watched here."""
        return self._here.received_of(plant)

    def not_stored(self, plant: str) -> None:
        """Count that what is remembered of a plant could not be stored."""
        self._here.not_stored(plant)

    def meet(self, plant: str, now_ns: int, *, vouched: bool) -> None:
        """Know of a plant, if it is new.

        Args:
            plant: its name.
            now_ns: now.
            vouched: whether it is certain that there is such a plant; if not, see `admission`.
        """
        if plant in self._met:
            if vouched:
                self._strangers.vouch(plant)
            return
        if len(self._met) >= MOST_PLANTS or not (vouched or self._strangers.have_room):
            return
        try:
            keys.check_plant(plant)
        except ValueError:
            return
        self._met[plant] = None
        if not vouched:
            self._strangers.meet(plant, now_ns)
        if self._crew.is_ours(plant):
            self._arrive(plant, now_ns, taken_over=False)

    def _forget(self, plant: str) -> None:
        """Know of a plant no longer."""
        del self._met[plant]
        if plant in self._arrivals:
            self._arrivals.end(plant)
        if self._here.remove(plant) is not None:
            self._in_charge(plant, False)
        self._before.forget(plant)
        self._forget_keys(plant)

    def _forget_keys(self, plant: str) -> None:
        for signal in self._signals:
            self._plants.pop(keys.key(plant, keys.SAMPLE, signal), None)

    def _share_out(self, now_ns: int) -> None:
        """Begin to watch what is ours now, and cease to watch what is not."""
        for plant in list(self._met):
            ours = self._crew.is_ours(plant)
            watched, arriving = plant in self._here, plant in self._arrivals
            if ours and not (watched or arriving):
                self._arrive(plant, now_ns, taken_over=True)
            elif arriving and not ours:
                self._arrivals.end(plant)
            elif watched and not ours:
                is_known = self.is_worth_storing(plant)
                if (state := self.release(plant)) is not None and is_known:
                    self._store(plant, state)

    def _arrive(self, plant: str, now_ns: int, *, taken_over: bool) -> None:
        if self._ask_past(plant, taken_over):
            self._arrivals.begin(plant)
        else:
            self.adopt(plant, None, now_ns)
            self._note_silence(plant, self.monitor(plant))

    # --- what the loop calls ---------------------------------------------------------------------------------

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Take in what was published: a sample of a plant, or another monitor's alarm."""
        return self.on_messages([message], now_ns)

    def on_messages(self, messages: list[Encoded], now_ns: int) -> list[Publication]:
        """Take in what was published, in the order of each plant."""
        if self._held is not None:
            self._held += map(cut, messages)
            return [] if len(self._held) < MOST_HELD else self.go_on((), now_ns)
        return self._judged(messages, now_ns)

    def _judged(self, messages: list[Encoded], now_ns: int) -> list[Publication]:
        publications, messages, touched = self._here.on_messages(messages, now_ns)
        publications = self._before.new(publications)
        for message in messages:
            plant = self._plants.get(message.key) or self._plant_of(message, now_ns)
            own = self._here.own(plant)
            messages_of = self._strangers.hear(plant, now_ns) if plant in self._strangers else 0
            if own is not None:
                touched.add(plant)
                if self._recent.again(plant, message, now_ns):
                    own.pass_over()
                else:
                    publications += self._before.new(own.on_message(message, now_ns))
            elif plant in self._arrivals:
                self._arrivals.keep(plant, message)
            elif messages_of >= PROVEN_MESSAGES:
                self._strangers.vouch(plant)
        for plant in [plant for plant in touched if plant in self._strangers]:
            own = self._here.own(plant)
            if own is not None and own.rows >= PROVEN_ROWS:
                self._strangers.vouch(plant)
        for plant in self._here.touched(touched):
            self._forget_keys(plant)
        return publications

    def _plant_of(self, message: Encoded, now_ns: int) -> str:
        """Whose sample it is; empty if it is none."""
        topic = keys.parse(message.key)
        if topic is None or topic.kind not in (keys.SAMPLE, keys.ALARM):
            return ""
        self.meet(topic.plant, now_ns, vouched=False)
        if topic.kind == keys.ALARM:
            if topic.plant in self._met and topic.plant not in self._here:  # or it is our own voice
                self._before.hear(topic.plant, message)
            return ""
        if topic.plant in self._met and topic.name in self._signals:
            self._plants[message.key] = topic.plant
        return topic.plant

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply | None, list[Publication]]:
        """Let a person act on a plant's alarms; None: the plant is another's to answer for."""
        topic = keys.parse(question.key)
        monitor = self._here.alone(topic.plant) if topic is not None and not self.holds else None
        return (None, []) if monitor is None else monitor.on_command(question, now_ns)

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Publish the health of the plants' monitors where it is due, and silences of plants."""
        if self.holds:
            return []
        if self._patience_ns is not None and now_ns >= self._patience_ns:
            self._patience_ns = None
            if self._crew.presume_gone():
                self._share_out(now_ns)
        for plant in self._strangers.forget(now_ns):
            self._forget(plant)
        return self._here.on_tick(now_ns)

    def next_tick_ns(self) -> int:
        """When the first of the plants is due."""
        if self.holds:
            return NEVER_NS
        due_ns = self._here.next_tick_ns()
        return due_ns if self._patience_ns is None else min(due_ns, self._patience_ns)

    @property
    def finished(self) -> bool:
        """Never: a fleet is watched until the monitor is stopped."""
        return False

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Publish the health of all for the last time."""
        return self._here.on_stop(now_ns)

    def copy(self, plant: str, name: str) -> None:
        """Watch another plant that is, so far, like a quiet one: for trials with many plants."""
        self._here.copy(plant, name)
        self._met[name] = None
        self._in_charge(name, True)

    def reports(self, now_ns: int) -> Iterator[tuple[str, str]]:
        """What people are to be told: plant and line."""
        return self._here.reports(now_ns)

    def tracebacks(self) -> Iterator[tuple[str, str]]:
        """Plant and traceback of each contained error that was reported."""
        return self._here.tracebacks()
