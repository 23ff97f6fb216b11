"""The watch over a fleet as a process: configuration, bus, core, loop."""

import secrets
import time
from pathlib import Path

import structlog

from monitor_node.alarms.commands import COMMANDS
from monitor_node.alarms.kpis import are_of_nothing
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.fleet import sharding
from monitor_node.fleet.config import FleetConfig
from monitor_node.fleet.monitor import FleetMonitor
from monitor_node.fleet.partition import Absence
from monitor_node.fleet.sharding import Crew
from monitor_node.fleet.watched_plants import WatchedPlants
from monitor_node.health import NODE
from monitor_node.ingest.rejects import Refusals
from monitor_node.other_monitors import OtherMonitors, log_report
from monitor_node.state.monitor_state import OtherSettingsError
from monitor_node.state.seal import ForeignFileError
from monitor_node.storage.fleet_states import FleetStates
from monitor_node.storage.kept_aside import DAMAGED, OTHER_SETTINGS
from monitor_node.storage.state_recovery import Pasts
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmKpis, CommandReply
from reactorwatch.errors import InputError
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.bus import Bus
from reactorwatch.runtime.config import BusConfig, MetricsConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.metrics import FleetMetrics, serve_metrics
from reactorwatch.runtime.model_file import read_model_on_bus_clock
from reactorwatch.runtime.security.command_rate import CommandRateLimiter, sender_name

log = structlog.get_logger()

DRAIN_TIMEOUT_S = 0.5
"""As for the monitor of one plant."""

PASSING = (keys.HEALTH, keys.ALARM_KPIS)
"""Told again and again of each plant; to remember them would take more than all else of a plant."""

MOST_TOKENS = 200
"""Plants for which a token is shown. Zenoh takes the longer for one the more there are: of 10,000, minutes."""

REPORT_EVERY_NS = 10_000_000_000

LOOK_EVERY_NS = 100_000_000
"""For plants whose past was found, and for states that are to be stored."""

MOST_STORED = 20
"""Plants whose state is stored at a time: half a millisecond each. Of thousands, each is stored less often."""


class FleetNode(FleetMonitor):
    """A fleet's monitor as others see it: it shows which plants it watches, stores what it remembers of them, and logs.

    The figures of a plant's alarms are told from the first of them on. Before, they would be nothing, told of each
    plant every minute, on a key that takes three kilobytes here and as much in the router.

    Args:
        config: how each plant is watched.
        fleet: which plants.
        bus: an open bus.
        start_ns: now.
        states: where what is remembered of each plant is kept; None: nowhere.
        metrics: where the counts of each plant are shown; None: nowhere.

    Raises:
        InputError: settings that do not fit together, or a model that cannot be used.
    """

    def __init__(
        self,
        config: MonitorConfig,
        fleet: FleetConfig,
        bus: Bus,
        start_ns: int,
        states: FleetStates | None = None,
        metrics: FleetMetrics | None = None,
    ) -> None:
        self._bus, self.metrics = bus, metrics
        self.expression = fleet.plants or f"{keys.ROOT}/{config.plant}"
        self._states = states
        self._pasts = Pasts(bus, self._states, lambda plant, line: log.warning(line, plant=plant))
        self._every_ns = int(config.state_every_s * 1e9)
        self._absence = Absence(lambda: bus.has_router)
        self._deaf = len(self.subscriptions)
        self._changed: set[str] = set()  # plants of which an alarm changed since their state was stored
        self._round: list[str] = []  # plants that are looked at next, whether something came of them
        self._round_ns = self._look_ns = start_ns
        self._stored_at: dict[str, int] = {}  # of each plant, how many messages had come when it was stored
        self._said: dict[str, str] = {}
        self._figured: set[str] = set()  # keys of the figures of alarms of which there were any
        self._shown: set[str] = set()
        self._report_ns = start_ns
        self._forgotten_told = 0
        self._rate, self._commands_refused = CommandRateLimiter(), Refusals()
        # The older of two with the same shard is in charge: names sort by the time of the start.
        name = f"{start_ns:020d}-{secrets.token_hex(4)}"
        self.crew = Crew(self.expression, sharding.parsed(fleet.shard), name)
        self._others = OtherMonitors(self.crew.token, lambda: self.plants)
        model = read_model_on_bus_clock(config.model)
        super().__init__(
            config,
            start_ns,
            self.crew,
            model=model,
            points=fleet.points,
            ask_past=self._find_past,
            store=self._keep,
            unusable=self._keep_aside,
            put_back=self._put_back,
            in_charge=self._show,
        )
        for plant in sorted({*states.plants, *states.plants_aside}) if states is not None else []:
            if keys.matches(self.expression, f"{keys.ROOT}/{plant}"):
                self.meet(plant, start_ns, vouched=True)

    @property
    def subscriptions(self) -> tuple[str, ...]:
        """What it listens to."""
        return keys.samples_of(self.expression), f"{self.expression}/{keys.ALARM}/**"

    @property
    def tokens(self) -> tuple[str, ...]:
        """Key expressions of the liveliness tokens that it subscribes to: of fleets, plants and plants' monitors."""
        monitors = keys.monitor_token(self.expression.removeprefix(f"{keys.ROOT}/"), "*")
        return keys.FLEET_TOKENS, f"{self.expression}/{keys.ALIVE}/*", monitors

    def _show(self, plant: str, ours: bool) -> None:
        token = keys.key(plant, keys.ALIVE, NODE)
        self._stored_at.pop(plant, None)
        if self.metrics is not None:
            if ours:
                self.metrics.add_plant(plant, lambda: self.alarms_of(plant))
            else:
                self.metrics.remove_plant(plant)
        if ours and self.crew.is_shared:
            self._changed.add(plant)  # another who was only cut off is to find that we have gone on from his state
        log.info("watching" if ours else "no longer watching", plant=plant)
        for report in self._others.check(plant) if ours else ():
            log_report(report)
        if ours and len(self._shown) < MOST_TOKENS:
            self._shown.add(token)
            self._bus.declare_token(token)
        elif token in self._shown:
            self._shown.remove(token)
            self._bus.undeclare_token(token)

    def on_messages(self, messages: list[Encoded], now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; alarms are logged."""
        return self._attended(now_ns) + self._noted(super().on_messages(messages, now_ns))

    def on_alive(self, token: str, is_alive: bool, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; if it is our own that went, others may have our plants."""
        if token == self.crew.token and not is_alive:
            self._absence.begins(now_ns)
        log_report(self._others.note(token, is_alive=is_alive))
        return self._attended(now_ns) + self._noted(super().on_alive(token, is_alive, now_ns))

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply | None, list[Publication]]:
        """See `FleetMonitor`; alarms are logged; too many commands, of whatever plants, are refused."""
        topic = keys.parse(question.key)
        if topic is None or self.holds or not self.is_watched(topic.plant):
            return None, []
        refusal = self._rate.check(sender_name(question), now_ns)
        if refusal is not None:
            self._commands_refused.add("too_many_commands", refusal)
            if (own := self.own(topic.plant)) is not None:  # a quiet plant stays one
                own.refusals.add("too_many_commands", refusal)
            return CommandReply(accepted=False, text=refusal), []
        reply, publications = super().on_command(question, now_ns)
        return reply, self._noted(publications)

    def on_tick(self, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; what is remembered is stored, and what is to be told of it is logged."""
        publications = self._attended(now_ns)
        if now_ns >= self._look_ns:
            self._look_ns = now_ns + LOOK_EVERY_NS
            if not self._bus.has_router:
                self._absence.begins(now_ns)
            self._store_due(now_ns)
            for past in self._pasts.found():
                publications += self._noted(self.on_past(past, now_ns))
                self._report_ns = now_ns  # a state that cannot be used is reported at once
        publications += self._noted(super().on_tick(now_ns))
        if now_ns >= self._report_ns:
            self._report_ns = now_ns + REPORT_EVERY_NS
            for plant, line in self.reports(now_ns):
                log.warning(line, plant=plant)
            for plant, text in self.tracebacks():
                log.debug("traceback", plant=plant, traceback=text)
            if (refused := self._commands_refused.report(now_ns)) is not None:
                log.warning(refused)
            if self.forgotten > self._forgotten_told:
                self._forgotten_told = self.forgotten
                log.warning("plants were forgotten that showed no token and said nothing more", so_far=self.forgotten)
        return publications

    def next_tick_ns(self) -> int:
        """See `FleetMonitor`; or when to look what is to be stored, and what was found."""
        due_ns = super().next_tick_ns()
        if self._states is None and not self._pasts.is_waiting:
            return due_ns
        return min(due_ns, self._look_ns)

    def listens(self) -> None:
        """One of the subscriptions hands on what is published from now on."""
        self._deaf -= 1
        if not self._deaf:
            self._pasts.begin()

    def on_stop(self, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; all is stored for the last time."""
        self._pasts.close()
        if self._states is not None:
            for plant in filter(self.is_worth_storing, self.plants):
                self._states.put(plant, self.state_of(plant))
            self._states.close()
            self._count_failures()
        return super().on_stop(now_ns)

    def _attended(self, now_ns: int) -> list[Publication]:
        """Judge nothing while others may have our plants; then, of those that they have, go on from their states."""
        absent = self._absence.lasts(now_ns)
        if self._states is None or absent == self.holds:
            return []
        if absent:
            if self.crew.is_shared:
                log.warning("the other monitors may take us for gone: nothing is judged until we are back")
                self.hold()
            return []
        others = self._states.of_others(self.plants)
        log.info("back", plants=len(self.plants), watched_by_others=len(others))
        return self._noted(self.go_on(others, now_ns))

    # --- what survives a restart -----------------------------------------------------------------------------

    def _find_past(self, plant: str, taken_over: bool) -> bool:
        if self._states is None and not taken_over:
            return False
        self._pasts.ask(plant)
        return True

    def _keep(self, plant: str, state: bytes) -> None:
        if self._states is not None:
            self._states.put(plant, state)

    def _keep_aside(self, plant: str, why: InputError) -> str:
        if self._states is None:
            return ""
        if isinstance(why, ForeignFileError):
            name = self._states.leave_alone(plant)
            return f", and {name} is left as it is; nothing is stored of the plant until it is moved away"
        ending = OTHER_SETTINGS if isinstance(why, OtherSettingsError) else DAMAGED
        return f", and the state kept as {self._states.keep_aside(plant, ending)}"

    def _put_back(self, plant: str, monitor: Monitor) -> bool:
        """Restore a plant's monitor from a state that was kept aside and fits now; returns whether there is one."""
        if self._states is None:
            return False
        name = self._states.put_back(plant, monitor.from_bytes)
        if name is not None:
            log.warning(f"{name} fits and is in use again", plant=plant)
        return name is not None

    def _store_due(self, now_ns: int) -> None:
        """Store plants of which an alarm changed, which has been told by now, and some of which something came."""
        if self._states is None or self.holds:
            return
        self._count_failures()
        for plant in self._states.lost():
            log.info("another monitor has stored a newer state", plant=plant)
            self.rejoin(plant, now_ns)
        due = [plant for plant in self._changed if self.received_of(plant) is not None]
        self._changed.clear()
        if not self._round and not 0 <= now_ns - self._round_ns < self._every_ns:
            self._round, self._round_ns = self.plants, now_ns
        looked = 0
        while self._round and looked < MOST_STORED and self._states.has_room:
            plant, looked = self._round.pop(), looked + 1
            if self.received_of(plant) not in (None, self._stored_at.get(plant)):
                due.append(plant)
        for plant in filter(self.is_worth_storing, due):
            self._states.put(plant, self.state_of(plant))
            self._stored_at[plant] = self.received_of(plant) or 0

    def _count_failures(self) -> None:
        """Count what could not be stored, and say why, once."""
        failures = self._states.failures() if self._states is not None else []
        for plant, why in failures:
            self.not_stored(plant)
            self._stored_at.pop(plant, None)
            if self._said.get(plant) != why:
                self._said[plant] = why
                log.warning(why, plant=plant)

    def _noted(self, publications: list[Publication]) -> list[Publication]:
        """Log alarms, and note that their plants are to be stored; returns what is to be told."""
        told: list[Publication] = []
        for publication in publications:
            alarm = publication.message
            if isinstance(alarm, AlarmKpis) and publication.key not in self._figured:
                if are_of_nothing(alarm):
                    continue
                self._figured.add(publication.key)
            told.append(publication)
            if isinstance(alarm, Alarm):
                topic = keys.parse(publication.key)
                plant = topic.plant if topic is not None else ""
                self._changed.add(plant)
                self._look_ns = 0  # as soon as it has been told
                log.info("alarm", plant=plant, alarm=alarm.alarm, change=alarm.event, by=alarm.by, text=alarm.text)
        return told


def run(
    config: MonitorConfig,
    fleet: FleetConfig,
    bus_config: BusConfig,
    metrics_config: MetricsConfig = MetricsConfig(),  # noqa: B008 (it is frozen)
) -> None:
    """Watch the plants until SIGINT or SIGTERM.

    Args:
        config: how each plant is watched.
        fleet: which plants.
        bus_config: where the bus is.
        metrics_config: where the counts are shown.

    Raises:
        InputError: settings that do not fit together, or that the bus cannot use; a folder where nothing can be stored.
    """
    for setting in ("alarm_state_file", "state_file"):
        if getattr(config, setting) is not None:
            raise InputError(f"{setting} holds what is known of one plant; a fleet takes [fleet] state, a folder")
    # Settings that make no monitor are refused now, and nobody waits for what has to be compiled.
    WatchedPlants(config, 0, read_model_on_bus_clock(config.model), points=fleet.points).prepare()
    states = FleetStates(Path(fleet.state)) if fleet.state is not None else None
    with serve_metrics(metrics_config, FleetMetrics(NODE), NODE) as metrics, stop_on_signals() as stop:
        bus = bus_zenoh.connect(bus_config, NODE, stop, uncached=PASSING, many_keys=True)
        if bus is None:
            return
        try:
            watch(FleetNode(config, fleet, bus, time.time_ns(), states, metrics), bus, stop)
        finally:
            bus.close()


def watch(node: FleetNode, bus: Bus, stop: StopSignal) -> None:
    """Watch the plants until asked to stop."""
    log.info("listening", plants=node.expression)
    on_publish = node.metrics.on_publish if node.metrics is not None else None
    loop = EventLoop(node, bus, stop, drain_timeout_s=DRAIN_TIMEOUT_S, on_publish=on_publish)
    loop.subscribe(*node.subscriptions, on_history_end=node.listens, on_batch=node.on_messages)
    loop.subscribe_liveliness(*node.tokens, on_token=node.on_alive)
    loop.accept_commands(*(f"{node.expression}/{keys.COMMAND}/{name}" for name in COMMANDS))
    bus.declare_token(node.crew.token)
    loop.run()
