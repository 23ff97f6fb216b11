"""The monitor of a fleet as a process: configuration, bus, core, loop."""

import secrets
import time
from collections.abc import Callable
from pathlib import Path

import structlog

from monitor_node.alarms.kpis import is_empty
from monitor_node.config import MonitorConfig
from monitor_node.core import COMMANDS, Monitor
from monitor_node.diagnosis_worker import DiagnosisWorker
from monitor_node.fleet import sharding
from monitor_node.fleet.callbacks import Callbacks
from monitor_node.fleet.config import FleetConfig
from monitor_node.fleet.monitor import FleetMonitor
from monitor_node.fleet.partition import LeaseMonitor
from monitor_node.fleet.plant_kinds import ANY, PlantKind, load_kinds
from monitor_node.fleet.sharding import ShardGroup
from monitor_node.fleet.watched_plants import WatchedPlants
from monitor_node.health.message import NODE
from monitor_node.health.other_monitors import OtherMonitors, log_report
from monitor_node.ingest.pending import PlantHistory
from monitor_node.ingest.rejects import RejectCounter
from monitor_node.state.monitor_state import OtherSettingsError
from monitor_node.state.seal import ForeignFileError
from monitor_node.storage.fleet_states import FleetStates
from monitor_node.storage.kept_aside import DAMAGED, OTHER_SETTINGS
from monitor_node.storage.state_recovery import StateRecovery
from monitor_node.watched_process import load_process
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmKpis, Baseline, CommandReply
from reactorwatch.errors import InputError
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.bus import Bus
from reactorwatch.runtime.config import BusConfig, MetricsConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.metrics import Metrics, serve_metrics
from reactorwatch.runtime.security.command_rate import CommandRateLimiter, sender_name

log = structlog.get_logger()

DRAIN_TIMEOUT_S = 0.5
"""Time for messages on their way at the end, as for the monitor of one plant."""

UNCACHED = (keys.HEALTH, keys.ALARM_KPIS)
"""Periodic messages of each plant; a cache of them would take more memory than all else of a plant."""

MOST_TOKENS = 200
"""Plants with a liveliness token. Zenoh's time for one grows with their number: 10,000 take minutes."""

LOG_INTERVAL_NS = 10_000_000_000

POLL_NS = 100_000_000
"""Interval of checks for states to store."""

MOST_STORED = 20
"""Plants whose state is stored at a time: half a millisecond each. With thousands, each is stored less often."""


class FleetNode(FleetMonitor):
    """A fleet's monitor with its liveliness tokens, stored states and logs.

    The KPIs of a plant's alarms are published from its first alarm on. Before, they would be empty, every minute for
    each plant, on a key that takes three kilobytes here and as much in the router.

    Args:
        config: settings of each plant's monitor.
        fleet: settings of the fleet.
        bus: an open bus.
        start_ns: present time.
        states: stored states; None: nothing is stored.
        metrics: metrics of each plant; None: there are none.

    Raises:
        InputError: the settings are inconsistent, or the model is unusable.
    """

    def __init__(
        self,
        config: MonitorConfig,
        fleet: FleetConfig,
        bus: Bus,
        start_ns: int,
        states: FleetStates | None = None,
        metrics: Metrics | None = None,
    ) -> None:
        self._bus, self.metrics = bus, metrics
        self.expression = fleet.plants or f"{keys.ROOT}/{config.plant}"
        self._states = states
        self._recovery = StateRecovery(
            bus, self._states, self._is_contested, lambda plant, line: log.warning(line, plant=plant)
        )
        self._every_ns = int(config.state_every_s * 1e9)
        self._worker = DiagnosisWorker()
        self._lease = LeaseMonitor(lambda: bus.has_router)
        self._pending_subscriptions = len(self.subscriptions)
        self._changed: set[str] = set()  # plants with a changed alarm or a command since their state was stored
        self._round: list[str] = []  # plants to check for new messages
        self._round_ns = self._poll_ns = start_ns
        self._stored_at: dict[str, int] = {}  # number of messages by plant when its state was stored
        self._logged: dict[str, str] = {}
        self._kpi_keys: set[str] = set()  # keys of KPIs that are not empty
        self._tokens: set[str] = set()
        self._report_ns = start_ns
        self._evicted_logged = 0
        self._excess_logged = False
        self._rate, self._commands_refused = CommandRateLimiter(), RejectCounter()
        # The older of two monitors with the same shard is active: names sort by the time of the start.
        name = f"{start_ns:020d}-{secrets.token_hex(4)}"
        self.shards = ShardGroup(self.expression, sharding.parse_shard(fleet.shard), name)
        self._others = OtherMonitors(self.shards.token, lambda: self.plants)
        config = fleet.share_promise(config)
        kinds = load_kinds(config, fleet)
        config, model = load_process(config)
        self._fleet = fleet
        super().__init__(
            config,
            start_ns,
            self.shards,
            Callbacks(
                request_history=self._request_recovery,
                store=self._store_state,
                unusable=self._keep_aside,
                put_back=self._restore_kept_aside,
                claimed_elsewhere=self._is_claimed_elsewhere,
                on_ownership=self._set_ownership,
                diagnose=self._worker.submit,
            ),
            model=model,
            points=fleet.points,
            kinds=kinds,
        )
        for plant in sorted({*states.plants, *states.plants_aside}) if states is not None else []:
            if keys.matches(self.expression, f"{keys.ROOT}/{plant}"):
                self.register(plant, start_ns, verified=True)

    @property
    def subscriptions(self) -> tuple[str, ...]:
        """Key expressions of the subscriptions."""
        return keys.samples_of(self.expression), f"{self.expression}/{keys.ALARM}/**"

    @property
    def tokens(self) -> tuple[str, ...]:
        """Key expressions of the liveliness tokens that it subscribes to: of fleets, plants and plants' monitors."""
        monitors = keys.monitor_token(self.expression.removeprefix(f"{keys.ROOT}/"), "*")
        return keys.FLEET_TOKENS, f"{self.expression}/{keys.ALIVE}/*", monitors

    @property
    def _promise_excess(self) -> str | None:
        """Text for more plants than share the false alarms of the fleet; None: there are not more."""
        promised, plants = self._fleet.false_alarms_per_day, self.registered_plants
        if promised is None or plants <= self._fleet.divisor:
            return None
        return (
            f"the fleet has {plants} plants, and false_alarms_per_day is divided among {self._fleet.divisor}: up to "
            f"{promised * plants / self._fleet.divisor:.3g} false alarms a day may come; set [fleet] most_plants"
        )

    def _set_ownership(self, plant: str, ours: bool) -> None:
        token = keys.key(plant, keys.ALIVE, NODE)
        self._stored_at.pop(plant, None)
        if self.metrics is not None:
            if ours:
                self.metrics.add_plant(plant, lambda: self.alarms_of(plant))
            else:
                self.metrics.remove_plant(plant)
        if ours and self.shards.is_shared:
            self._changed.add(plant)  # a partitioned monitor must find a newer state
        log.info("watching" if ours else "no longer watching", plant=plant)
        for report in self._others.check(plant) if ours else ():
            log_report(report)
        if ours and len(self._tokens) < MOST_TOKENS:
            self._tokens.add(token)
            self._bus.declare_token(token)
        elif token in self._tokens:
            self._tokens.remove(token)
            self._bus.undeclare_token(token)

    def on_messages(self, messages: list[Encoded], now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; alarms are logged."""
        return self._check_lease(now_ns) + self._log_alarms(super().on_messages(messages, now_ns))

    def on_alive(self, token: str, is_alive: bool, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; without its own token this monitor's lease may have expired."""
        if token == self.shards.token and not is_alive:
            self._lease.expire(now_ns)
        log_report(self._others.on_token(token, is_alive=is_alive))
        return self._check_lease(now_ns) + self._log_alarms(super().on_alive(token, is_alive, now_ns))

    def on_history(self, past: PlantHistory, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; alarms are logged, and an unusable state is reported at once."""
        publications = self._check_lease(now_ns) + self._log_alarms(super().on_history(past, now_ns))
        self._report_ns = now_ns
        return publications

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply | None, list[Publication]]:
        """See `FleetMonitor`; alarms are logged; too many commands, over all plants, are refused."""
        topic = keys.parse(question.key)
        if topic is None or self.paused or not self.is_watched(topic.plant):
            return None, []
        refusal = self._rate.check(sender_name(question), now_ns)
        if refusal is not None:
            self._commands_refused.add("too_many_commands", refusal)
            if (own := self.watched.active_monitor(topic.plant)) is not None:  # a quiet plant stays packed
                own.rejects.add("too_many_commands", refusal)
            return CommandReply(accepted=False, text=refusal), []
        reply, publications = super().on_command(question, now_ns)
        if reply is not None and reply.accepted:
            self._changed.add(topic.plant)
            self._poll_ns = 0
        return reply, self._log_alarms(publications)

    def on_tick(self, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; states are stored, and notes are logged."""
        publications = self._check_lease(now_ns)
        if now_ns >= self._poll_ns:
            self._poll_ns = now_ns + POLL_NS
            if not self._bus.has_router:
                self._lease.expire(now_ns)
            self._store_due(now_ns)
            for plant, finding in self._worker.pop_findings():
                log.info("training diagnosed", plant=plant, verdict=finding.verdict)
                self.watched.on_finding(plant, finding)
        publications += self._log_alarms(super().on_tick(now_ns))
        if now_ns >= self._report_ns:
            self._report_ns = now_ns + LOG_INTERVAL_NS
            for plant, line in self.watched.reports(now_ns):
                log.warning(line, plant=plant)
            for plant, text in self.watched.tracebacks():
                log.debug("traceback", plant=plant, traceback=text)
            if (refused := self._commands_refused.report(now_ns)) is not None:
                log.warning(refused)
            if (excess := self._promise_excess) is not None and not self._excess_logged:
                self._excess_logged = True
                log.warning(excess)
            if self.evictions > self._evicted_logged:
                self._evicted_logged = self.evictions
                log.warning("unverified plants without messages were evicted", so_far=self.evictions)
        return publications

    def next_tick_ns(self) -> int:
        """See `FleetMonitor`; or the next check for states to store."""
        due_ns = super().next_tick_ns()
        if self._states is None and not self._worker.is_busy:
            return due_ns
        return min(due_ns, self._poll_ns)

    def on_subscribed(self, call: Callable[[Callable[[int], list[Publication]]], None]) -> None:
        """Count a completed subscription; when all are, start the recovery.

        Args:
            call: see `EventLoop.call`.
        """
        self._pending_subscriptions -= 1
        if not self._pending_subscriptions:
            self._recovery.start(lambda past: call(lambda now_ns: self.on_history(past, now_ns)))

    def on_stop(self, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; states are stored for the last time."""
        self._recovery.close()
        self._worker.close()
        if self._states is not None:
            for plant in filter(self.is_worth_storing, self.plants):
                self._states.put(plant, self.state_of(plant))
            self._states.close()
            self._count_failures()
        return super().on_stop(now_ns)

    def _check_lease(self, now_ns: int) -> list[Publication]:
        """Pause while the lease may have expired; then resume, from others' states for plants that they owned."""
        absent = self._lease.is_expired(now_ns)
        if self._states is None or absent == self.paused:
            return []
        if absent:
            if self.shards.is_shared:
                log.warning("the lease of this monitor may have expired: its plants are paused until it is back")
                self.pause()
            return []
        others = self._states.adopted_elsewhere(self.plants)
        log.info("back", plants=len(self.plants), watched_by_others=len(others))
        return self._log_alarms(self.resume(others, now_ns))

    # --- states ----------------------------------------------------------------------------------------------

    def _request_recovery(self, plant: str, taken_over: bool) -> bool:
        if self._states is None and not taken_over:
            return False
        self._recovery.request(plant)
        return True

    def _is_contested(self, plant: str) -> bool:
        return self.shards.is_shared and self.is_pending(plant)

    def _is_claimed_elsewhere(self, plant: str) -> bool:
        return self._states is not None and self.shards.is_shared and self._states.is_claimed_elsewhere(plant)

    def _store_state(self, plant: str, state: bytes) -> None:
        if self._states is not None:
            self._states.put(plant, state)

    def _keep_aside(self, plant: str, why: InputError) -> str:
        if self._states is None:
            return ""
        if isinstance(why, ForeignFileError):
            name = self._states.protect(plant)
            return f", and {name} is left as it is; nothing is stored of the plant until it is moved away"
        ending = OTHER_SETTINGS if isinstance(why, OtherSettingsError) else DAMAGED
        return f", and the state kept as {self._states.keep_aside(plant, ending)}"

    def _restore_kept_aside(self, plant: str, monitor: Monitor) -> bool:
        """Restore a plant's monitor from a state that was kept aside and fits now; returns True if there is one."""
        if self._states is None:
            return False
        name = self._states.put_back(plant, monitor.from_bytes)
        if name is not None:
            log.warning(f"{name} fits and is in use again", plant=plant)
        return name is not None

    def _store_due(self, now_ns: int) -> None:
        """Store plants with a changed alarm, which is published by now, and some of those with new messages."""
        if self._states is None or self.paused:
            return
        self._count_failures()
        for plant in self._states.pop_lost():
            log.info("another monitor has stored a newer state", plant=plant)
            self.rejoin(plant, now_ns)
        due = [plant for plant in self._changed if self.watched.received_count(plant) is not None]
        self._changed.clear()
        if not self._round and not 0 <= now_ns - self._round_ns < self._every_ns:
            self._round, self._round_ns = self.plants, now_ns
        checked = 0
        while self._round and checked < MOST_STORED and self._states.has_room:
            plant, checked = self._round.pop(), checked + 1
            if self.watched.received_count(plant) not in (None, self._stored_at.get(plant)):
                due.append(plant)
        for plant in filter(self.is_worth_storing, due):
            self._states.put(plant, self.state_of(plant))
            self._stored_at[plant] = self.watched.received_count(plant) or 0

    def _count_failures(self) -> None:
        """Count failures to store states, and log each reason once."""
        failures = self._states.pop_failures() if self._states is not None else []
        for plant, why in failures:
            self.watched.count_not_stored(plant)
            self._stored_at.pop(plant, None)
            if self._logged.get(plant) != why:
                self._logged[plant] = why
                log.warning(why, plant=plant)

    def _log_alarms(self, publications: list[Publication]) -> list[Publication]:
        """Log alarms, and mark plants with changes for storing; returns publications without empty KPIs."""
        kept: list[Publication] = []
        for publication in publications:
            alarm = publication.message
            if isinstance(alarm, AlarmKpis) and publication.key not in self._kpi_keys:
                if is_empty(alarm):
                    continue
                self._kpi_keys.add(publication.key)
            kept.append(publication)
            if isinstance(alarm, Alarm | Baseline):
                topic = keys.parse(publication.key)
                plant = topic.plant if topic is not None else ""
                self._changed.add(plant)
                self._poll_ns = 0  # as soon as it is published
            if isinstance(alarm, Alarm):
                log.info("alarm", plant=plant, alarm=alarm.alarm, change=alarm.event, by=alarm.by, text=alarm.text)
        return kept


def run(
    config: MonitorConfig,
    fleet: FleetConfig,
    bus_config: BusConfig,
    metrics_config: MetricsConfig = MetricsConfig(),  # noqa: B008 (it is frozen)
) -> None:
    """Run a fleet's monitor until SIGINT or SIGTERM.

    Args:
        config: settings of each plant's monitor.
        fleet: settings of the fleet.
        bus_config: settings of the bus.
        metrics_config: settings of the metrics.

    Raises:
        InputError: the settings are inconsistent, or the folder of states cannot be written to.
    """
    for setting in ("alarm_state_file", "state_file"):
        if getattr(config, setting) is not None:
            raise InputError(f"{setting} holds what is known of one plant; a fleet takes [fleet] state, a folder")
    if fleet.share_per_30_days is not None:
        text = f"{fleet.false_alarms_per_day:g} false alarms a day are promised for {fleet.divisor} plants"
        log.info(text, per_plant_in_30_days=fleet.share_promise(config).false_alarms_per_30_days)
    # Inconsistent settings are refused here, and machine code is compiled before plants wait.
    config = fleet.share_promise(config)
    kinds = (*load_kinds(config, fleet), PlantKind(ANY, *load_process(config)))
    WatchedPlants(kinds, 0, points=fleet.points).prepare()
    states = FleetStates(Path(fleet.state)) if fleet.state is not None else None
    with serve_metrics(metrics_config, Metrics(NODE)) as metrics, stop_on_signals() as stop:
        bus = bus_zenoh.connect(bus_config, NODE, stop, uncached=UNCACHED, many_keys=True)
        if bus is None:
            return
        try:
            watch(FleetNode(config, fleet, bus, time.time_ns(), states, metrics), bus, stop)
        finally:
            bus.close()


def watch(node: FleetNode, bus: Bus, stop: StopSignal) -> None:
    """Run a fleet's monitor until it is asked to stop."""
    log.info("listening", plants=node.expression)
    on_publish = node.metrics.on_publish if node.metrics is not None else None
    loop = EventLoop(node, bus, stop, drain_timeout_s=DRAIN_TIMEOUT_S, on_publish=on_publish)
    loop.subscribe(*node.subscriptions, on_history_end=lambda: node.on_subscribed(loop.call), on_batch=node.on_messages)
    loop.subscribe_liveliness(*node.tokens, on_token=node.on_alive)
    loop.accept_commands(*(f"{node.expression}/{keys.COMMAND}/{name}" for name in COMMANDS))
    bus.declare_token(node.shards.token)
    loop.run()
