"""Monitor of a fleet: any set of plants in one process, each with its own state.

A plant is registered when one of its nodes shows a liveliness token, or when it sends a sample. Its owner follows from
the shards (see `sharding`): one monitor owns all plants, or several share them and take over from each other. A plant's
publications are the same, value for value, as if it were monitored alone.

A monitor that takes a plant over requests its history: the stored state, if there is one, and messages that the plant's
publishers still remember (`on_history`). With a state, alarms that the predecessor published are filtered out, so that
none is published twice. Without one the plant is trained again, but its alarms stay: monitors of a fleet subscribe to
each other's alarms. So an active one is not raised again, and it is cleared when its condition is over.

Two monitors may own a plant for a while: a stalled process does not know that it was replaced. So an adopted plant is
claimed, and the claim is checked between evaluation and publication of an alarm (`claimed_elsewhere`). Alarms of a
plant that another monitor has claimed are withheld, and the plant is adopted again if it is still owned.

While others may have taken over from this monitor nothing is evaluated (`pause`), until it is known which plants they
have (`resume`). For those it resumes from their states.

Nothing here reads a clock or does I/O.
"""

from collections.abc import Iterable, Sequence

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet.admission import PROVEN_MESSAGES, PROVEN_ROWS, PlantRegister
from monitor_node.fleet.callbacks import NO_CALLBACKS, Callbacks
from monitor_node.fleet.handed_over_alarms import HandedOverAlarms
from monitor_node.fleet.plant_kinds import ANY, PlantKind
from monitor_node.fleet.recently_adopted import RecentlyAdopted
from monitor_node.fleet.sharding import ShardGroup
from monitor_node.fleet.watched_plants import State, WatchedPlants
from monitor_node.ingest.pending import PendingPlants, PlantHistory, truncate
from monitor_node.replay.recorded_sessions import TIMEOUT_ALARM
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication, decode_as
from reactorwatch.contract.messages_pb2 import Alarm, CommandReply, Sample
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import NEVER_NS

PRESUME_GONE_NS = 10_000_000_000
"""Time after the start, when a shard without a monitor is presumed gone."""

MOST_HELD = 500_000
"""Messages buffered in a pause; with more they are evaluated, as late alarms are worse than alarms twice."""


class FleetMonitor:
    """Monitors of many plants.

    Args:
        config: settings of each plant's monitor; its plant name is ignored.
        start_ns: present time.
        shards: monitors that share the fleet.
        callbacks: functions of the node.
        model: see `Monitor`.
        points: see `Monitor`.
        kinds: plants of other processes; all others have `config` and `model`.

    Raises:
        InputError: the settings are inconsistent.

    Attributes:
        watched: the own plants with their monitors.
    """

    def __init__(
        self,
        config: MonitorConfig,
        start_ns: int,
        shards: ShardGroup,
        callbacks: Callbacks = NO_CALLBACKS,
        *,
        model: ProcessModel | None = None,
        points: bool = False,
        kinds: Sequence[PlantKind] = (),
    ) -> None:
        self._shards, self._callbacks = shards, callbacks
        all_kinds = (*kinds, PlantKind(ANY, config, model))
        self.watched = WatchedPlants(all_kinds, start_ns, points=points, diagnose=callbacks.diagnose)
        self._pending = PendingPlants()
        self._presume_gone_ns: int | None = start_ns + PRESUME_GONE_NS
        self._register = PlantRegister()
        configs = [kind.config for kind in all_kinds]
        self._signals = tuple(
            dict.fromkeys(name for item in configs for name in (*item.signals, *item.carried_signals))
        )
        self._plants: dict[str, str] = {}  # plants that are not quiet, by key of a sample
        self._handed_over, self._recent = HandedOverAlarms(self.watched.alarms), RecentlyAdopted()
        self._paused_messages: list[Encoded] | None = None  # buffered in a pause
        self._paused_histories: list[PlantHistory] = []

    # --- ownership -------------------------------------------------------------------------------------------

    @property
    def plants(self) -> list[str]:
        """The own plants."""
        return self.watched.plants

    @property
    def quiet(self) -> list[str]:
        """The own plants in packed form."""
        return self.watched.quiet

    def on_alive(self, token: str, is_alive: bool, now_ns: int) -> list[Publication]:
        """Process the liveliness token of a plant's node or of another monitor."""
        topic = keys.parse(token)
        if self._shards.on_token(token, is_alive=is_alive):
            self._reassign(now_ns)
        elif topic is not None and topic.kind == keys.ALIVE and is_alive:
            self.register(topic.plant, now_ns, verified=True)
        return []

    def on_history(self, past: PlantHistory, now_ns: int) -> list[Publication]:
        """Adopt a plant whose history was requested, if it is still owned: process the history and messages since.

        In a pause the history is buffered behind the messages, which may be alarms of the previous owner.
        """
        if self.paused:
            self._paused_histories.append(past)
            return []
        if past.plant not in self._pending:
            return []
        if past.state is not None:
            self._register.verify(past.plant)
        messages = self._pending.end(past.plant, past.messages)
        self._handed_over.on_history(past.plant, past.alarms)
        self.adopt(past.plant, past.state, now_ns)
        monitor = self.monitor(past.plant)
        publications: list[Publication] = []
        timeouts = self._timeouts_after(past.plant, monitor)
        for message in messages:
            # Rows from before a data timeout do not end it; the first row after it does.
            if timeouts and not monitor.has_pending_rows and _sample_time_ns(message) > timeouts[0].raised_ns:
                monitor.resume_from_alarms(timeouts)
                timeouts = []
            publications += self._evaluate(past.plant, monitor, message, now_ns)
        monitor.resume_from_alarms(timeouts)
        monitor.on_history_end()
        self._recent.add(past.plant, monitor, now_ns)
        self._handed_over.expire(past.plant)
        return self._confirm(publications, now_ns)

    def adopt(self, plant: str, state: State | None, now_ns: int) -> None:
        """Adopt a plant.

        Args:
            plant: name of the plant.
            state: state of the previous monitor, from `Monitor.to_bytes`; None: the plant is trained again. An unusable
                state is noted, and counts as none.
            now_ns: present time.
        """
        monitor = self.watched.new_monitor(plant, now_ns)
        unusable = kept = ""
        if state is not None:
            try:
                monitor.from_bytes(state)
            except InputError as error:
                kept = self._callbacks.unusable(plant, error)
                unusable, state = f"the state that was stored {error}", None
        if state is None and not self._callbacks.put_back(plant, monitor):
            monitor.resume_from_alarms(alarm for alarm in self._handed_over.of(plant) if alarm.alarm != TIMEOUT_ALARM)
            if unusable:
                monitor.notes.append(f"{unusable}; the plant is learned again{kept}")
                self._callbacks.store(plant, monitor.to_bytes())  # or the folder would not list the plant
        elif unusable:
            monitor.notes.append(f"{unusable}{kept}")
        self.watched.add(plant, monitor)
        self._register.add(plant)
        self._callbacks.on_ownership(plant, True)

    def _timeouts_after(self, plant: str, monitor: Monitor) -> list[Alarm]:
        """An active data timeout of a plant that its monitor does not know."""
        return self._handed_over.timeouts_after(plant, monitor.alarms.alarm(TIMEOUT_ALARM).raised_ns)

    def release(self, plant: str) -> State | None:
        """Release a plant; returns its state for the next owner. None: it was not owned."""
        monitor = self.watched.remove(plant)
        if monitor is None:
            return None
        self._callbacks.on_ownership(plant, False)
        return monitor.to_bytes()

    def rejoin(self, plant: str, now_ns: int, withheld_ns: int | None = None) -> None:
        """Adopt a plant again that another monitor also owned: resume from its state, if the plant is still owned.

        Args:
            plant: name of the plant.
            now_ns: present time.
            withheld_ns: time of the first change of an alarm that was not published; None: all were.
        """
        monitor = self.watched.remove(plant)
        if monitor is None:
            return
        self._handed_over.publish_ours(plant, monitor.alarms.all_alarms(), monitor.memory.last_ns, withheld_ns)
        self._callbacks.on_ownership(plant, False)
        if self._shards.is_ours(plant):
            self._start_adoption(plant, now_ns, taken_over=True)

    def pause(self) -> None:
        """Buffer messages until `resume`."""
        self._paused_messages = [] if self._paused_messages is None else self._paused_messages

    @property
    def paused(self) -> bool:
        """True while messages are buffered."""
        return self._paused_messages is not None

    def resume(self, others: Iterable[str], now_ns: int) -> list[Publication]:
        """Process buffered messages, and those to come.

        Args:
            others: own plants that others owned meanwhile, as far as known; their alarms show it, too.
            now_ns: present time.
        """
        held, self._paused_messages = self._paused_messages or [], None
        histories, self._paused_histories = self._paused_histories, []
        for plant in {*others, *self._reported_elsewhere(held)}:
            self.rejoin(plant, now_ns)
        publications = self._process(held, now_ns)
        return publications + [item for past in histories for item in self.on_history(past, now_ns)]

    def _confirm(self, publications: list[Publication], now_ns: int) -> list[Publication]:
        """Withhold publications on plants with a changed alarm that another monitor has claimed, and rejoin these."""
        withheld_ns: dict[str, int] = {}
        for item in publications:
            if isinstance(item.message, Alarm):
                plant, time_ns = _plant_of_key(item.key), item.message.time_ns
                withheld_ns[plant] = min(withheld_ns.get(plant, time_ns), time_ns)
        lost = [plant for plant in withheld_ns if self._callbacks.claimed_elsewhere(plant)]
        for plant in lost:
            self.rejoin(plant, now_ns, withheld_ns[plant])
        return [item for item in publications if _plant_of_key(item.key) not in lost] if lost else publications

    def _reported_elsewhere(self, messages: Iterable[Encoded]) -> set[str]:
        """Own plants for which another monitor published alarms on rows not yet processed here."""
        plants = set()
        for message in messages:
            topic = keys.parse(message.key)
            if topic is None or topic.kind != keys.ALARM:
                continue
            alarm, own = decode_as(message, Alarm), self.watched.detach(topic.plant)
            if alarm is not None and own is not None and alarm.time_ns > (own.memory.last_ns or 0):
                plants.add(topic.plant)
        return plants

    def monitor(self, plant: str) -> Monitor:
        """Monitor of a plant.

        Raises:
            InputError: the plant is not owned.
        """
        monitor = self.watched.detach(plant)
        if monitor is None:
            raise InputError(f"plant {plant!r} is not watched here (there are: {', '.join(self.plants)})")
        return monitor

    def is_watched(self, plant: str) -> bool:
        """True if a plant is owned."""
        return plant in self.watched

    def is_pending(self, plant: str) -> bool:
        """True while a plant's history is requested."""
        return plant in self._pending

    def state_of(self, plant: str) -> State:
        """State of a plant."""
        return self.watched.state_of(plant)

    def alarms_of(self, plant: str) -> list[Alarm] | None:
        """Alarms of a plant; None for a quiet plant, whose alarms have not changed."""
        own = self.watched.active_monitor(plant)
        return None if own is None else own.alarms.all_alarms()

    def is_worth_storing(self, plant: str) -> bool:
        """True if a plant is verified and has rows."""
        own = self.watched.active_monitor(plant)
        return not self._register.is_unverified(plant) and (own is None or own.rows > 0)

    @property
    def evictions(self) -> int:
        """Number of unverified plants that were evicted."""
        return self._register.evicted

    @property
    def registered_plants(self) -> int:
        """Number of registered plants, with any owner."""
        return len(self._register)

    def register(self, plant: str, now_ns: int, *, verified: bool) -> None:
        """Register a plant, if it is new.

        Args:
            plant: name of the plant.
            now_ns: present time.
            verified: True if the plant certainly exists; if not, see `admission`.
        """
        if self._register.register(plant, now_ns, verified=verified) and self._shards.is_ours(plant):
            self._start_adoption(plant, now_ns, taken_over=False)

    def _evict(self, plant: str) -> None:
        """Remove a plant that is not registered any more."""
        if plant in self._pending:
            self._pending.end(plant)
        if self.watched.remove(plant) is not None:
            self._callbacks.on_ownership(plant, False)
        self._handed_over.remove(plant)
        self._remove_keys(plant)

    def _remove_keys(self, plant: str) -> None:
        for signal in self._signals:
            self._plants.pop(keys.key(plant, keys.SAMPLE, signal), None)

    def _reassign(self, now_ns: int) -> None:
        """Adopt plants that are owned now, and release those that are not."""
        for plant in self._register.plants:
            ours = self._shards.is_ours(plant)
            watched, arriving = plant in self.watched, plant in self._pending
            if ours and not (watched or arriving):
                self._start_adoption(plant, now_ns, taken_over=True)
            elif arriving and not ours:
                self._pending.end(plant)
            elif watched and not ours:
                is_known = self.is_worth_storing(plant)
                if (state := self.release(plant)) is not None and is_known:
                    self._callbacks.store(plant, state)

    def _start_adoption(self, plant: str, now_ns: int, *, taken_over: bool) -> None:
        if self._callbacks.request_history(plant, taken_over):
            self._pending.start(plant)
        else:
            self.adopt(plant, None, now_ns)
            monitor = self.monitor(plant)
            monitor.resume_from_alarms(self._timeouts_after(plant, monitor))

    # --- event loop ------------------------------------------------------------------------------------------

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Process a message: a sample of a plant, or another monitor's alarm."""
        return self.on_messages([message], now_ns)

    def on_messages(self, messages: list[Encoded], now_ns: int) -> list[Publication]:
        """Process messages, which are in order for each plant."""
        if self._paused_messages is not None:
            self._paused_messages += map(truncate, messages)
            return [] if len(self._paused_messages) < MOST_HELD else self.resume((), now_ns)
        return self._process(messages, now_ns)

    def _process(self, messages: list[Encoded], now_ns: int) -> list[Publication]:
        publications, messages, touched = self.watched.on_messages(messages, now_ns)
        publications = self._handed_over.filter_new(publications)
        for message in messages:
            plant = self._plants.get(message.key) or self._plant_of(message, now_ns)
            own = self.watched.active_monitor(plant)
            messages_of = self._register.on_message(plant, now_ns) if self._register.is_unverified(plant) else 0
            if own is not None:
                touched.add(plant)
                if self._recent.is_repeat(plant, message, now_ns):
                    own.count_duplicate()
                else:
                    publications += self._evaluate(plant, own, message, now_ns)
            elif plant in self._pending:
                self._pending.add(plant, message)
            elif messages_of >= PROVEN_MESSAGES:
                self._register.verify(plant)
        for plant in [plant for plant in touched if self._register.is_unverified(plant)]:
            own = self.watched.active_monitor(plant)
            if own is not None and own.rows >= PROVEN_ROWS:
                self._register.verify(plant)
        for plant in self.watched.settle(touched):
            self._remove_keys(plant)
        return self._confirm(publications, now_ns)

    def _evaluate(self, plant: str, own: Monitor, message: Encoded, now_ns: int) -> list[Publication]:
        """Process a message of a plant; returns publications that its previous owners have not published."""
        before_ns, publications = own.memory.last_ns, own.on_message(message, now_ns)
        if before_ns is not None and own.memory.last_ns is not None and own.memory.last_ns < before_ns:
            self._handed_over.remove(plant)  # the clock was set back: their alarms would cover those to come
        return self._handed_over.filter_new(publications)

    def _plant_of(self, message: Encoded, now_ns: int) -> str:
        """Plant of a sample; empty for another message."""
        topic = keys.parse(message.key)
        if topic is None or topic.kind not in (keys.SAMPLE, keys.ALARM):
            return ""
        self.register(topic.plant, now_ns, verified=False)
        if topic.kind == keys.ALARM:
            if topic.plant in self._register and topic.plant not in self.watched:  # else it may be an own alarm
                self._handed_over.on_message(topic.plant, message)
            return ""
        if topic.plant in self._register and topic.name in self._signals:
            self._plants[message.key] = topic.plant
        return topic.plant

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply | None, list[Publication]]:
        """Execute an operator's command; None as reply: another monitor owns the plant."""
        plant = _plant_of_key(question.key)
        monitor = self.watched.detach(plant) if not self.paused else None
        if monitor is not None and self._callbacks.claimed_elsewhere(plant):
            self.rejoin(plant, now_ns)
            return None, []
        return (None, []) if monitor is None else monitor.on_command(question, now_ns)

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Publish health where it is due; raise the alarms of plants without data."""
        if self.paused:
            return []
        if self._presume_gone_ns is not None and now_ns >= self._presume_gone_ns:
            self._presume_gone_ns = None
            if self._shards.drop_unseen():
                self._reassign(now_ns)
        for plant in self._register.evict(now_ns):
            self._evict(plant)
        return self._confirm(self.watched.on_tick(now_ns), now_ns)

    def next_tick_ns(self) -> int:
        """Earliest deadline of the plants."""
        if self.paused:
            return NEVER_NS
        due_ns = self.watched.next_tick_ns()
        return due_ns if self._presume_gone_ns is None else min(due_ns, self._presume_gone_ns)

    @property
    def finished(self) -> bool:
        """Always False: a monitor runs until it is stopped."""
        return False

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Publish the health of all plants' monitors for the last time."""
        return self.watched.on_stop(now_ns)


def _plant_of_key(key: str) -> str:
    """Plant in a key; empty if there is none."""
    topic = keys.parse(key)
    return topic.plant if topic is not None else ""


def _sample_time_ns(message: Encoded) -> int:
    """Time of a sample; the earliest if the message is none."""
    sample = decode_as(message, Sample)
    return -NEVER_NS if sample is None else sample.time_ns
