"""The monitor of a fleet as a process: configuration, bus, core, loop."""

import time
from functools import partial
from pathlib import Path

import structlog

from monitor_node.alarms.incidents import is_empty
from monitor_node.config import MonitorConfig
from monitor_node.core import COMMANDS, Monitor
from monitor_node.diagnosis_worker import DiagnosisWorker
from monitor_node.fleet.config import FleetConfig, parse_shard
from monitor_node.fleet.monitor import FleetMonitor, load_kinds, prepare
from monitor_node.health import NODE, OtherMonitors
from monitor_node.ingest.samples import RejectCounter
from monitor_node.storage.state_files import StateFolder
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmKpis, Baseline, CommandReply
from reactorwatch.errors import InputError
from reactorwatch.records.folder import make_folder
from reactorwatch.runtime.bus import Bus
from reactorwatch.runtime.config import BusConfig, MetricsConfig
from reactorwatch.runtime.event_loop import EventLoop, StopSignal, stop_on_signals
from reactorwatch.runtime.metrics import Metrics, serve_metrics
from reactorwatch.runtime.retry import retry
from reactorwatch.runtime.security.command_rate import CommandRateLimiter, sender_name
from reactorwatch.runtime.start import instance_name, join

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
        token: own instance token, see `fleet_token`.

    Raises:
        InputError: the settings are inconsistent.
    """

    def __init__(
        self,
        config: MonitorConfig,
        fleet: FleetConfig,
        bus: Bus,
        start_ns: int,
        states: StateFolder | None = None,
        metrics: Metrics | None = None,
        token: str = "",
    ) -> None:
        self._bus, self._fleet, self.metrics, self._states = bus, fleet, metrics, states
        self.expression = plants_of(config, fleet)
        self._every_ns = int(config.state_every_s * 1e9)
        self._worker = DiagnosisWorker()
        self._others = OtherMonitors(token, lambda: self._monitors)
        self._changed: set[str] = set()  # plants with a changed alarm or a command since their state was stored
        self._round: list[str] = []  # plants to check for new messages
        self._round_ns = self._poll_ns = self._report_ns = start_ns
        self._stored_at: dict[str, int] = {}  # number of messages by plant when its state was stored
        self._logged: dict[str, str] = {}
        self._kpi_keys: set[str] = set()  # keys of KPIs that are not empty
        self._tokens: set[str] = set()
        self._evicted_logged, self._excess_logged = 0, False
        self._rate, self._commands_refused = CommandRateLimiter(), RejectCounter()
        super().__init__(
            load_kinds(fleet.share_promise(config), fleet),
            start_ns,
            parse_shard(fleet.shard),
            points=fleet.points,
            on_watch=self._on_watched,
            diagnose=self._worker.submit,
        )
        for plant in states.plants if states is not None else []:
            if keys.matches(self.expression, f"{keys.ROOT}/{plant}"):
                self.register(plant, start_ns, verified=True, restore=partial(self._restore, plant))
        if states is not None and states.claim.failure:
            log.warning(states.claim.failure)

    @property
    def tokens(self) -> tuple[str, ...]:
        """Key expressions of the liveliness tokens that it subscribes to: of fleets, plants and plants' monitors."""
        monitors = keys.monitor_token(self.expression.removeprefix(f"{keys.ROOT}/"), "*")
        return keys.FLEET_TOKENS, f"{self.expression}/{keys.ALIVE}/*", monitors

    def on_history_end(self) -> None:
        """See `Monitor.on_history_end`; the history of a plant that is cut off comes once its publishers are there."""
        for monitor in self._monitors.values():
            if not monitor.awaits_samples:
                monitor.on_history_end()

    def on_messages(self, messages: list[Encoded], now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; alarms are logged."""
        return self._log_alarms(super().on_messages(messages, now_ns))

    def on_alive(self, token: str, is_alive: bool, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; other monitors of the plants are logged."""
        self._others.on_token(token, is_alive=is_alive)
        return super().on_alive(token, is_alive, now_ns)

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply | None, list[Publication]]:
        """See `FleetMonitor`; alarms are logged; too many commands, over all plants, are refused."""
        topic = keys.parse(question.key)
        if topic is None or topic.plant not in self._monitors:
            return None, []
        refusal = self._rate.check(sender_name(question), now_ns)
        if refusal is not None:
            self._commands_refused.add("too_many_commands", refusal)
            self._monitors[topic.plant].rejects.add("too_many_commands", refusal)
            return CommandReply(accepted=False, text=refusal), []
        reply, publications = super().on_command(question, now_ns)
        if reply is not None and reply.accepted:
            self._changed.add(topic.plant)
            self._poll_ns = 0
        return reply, self._log_alarms(publications)

    def on_tick(self, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; states are stored, and notes are logged."""
        if now_ns >= self._poll_ns:
            self._poll_ns = now_ns + POLL_NS
            self._store_due(now_ns)
            for plant, finding in self._worker.pop_findings():
                log.info("training diagnosed", plant=plant, verdict=finding.verdict)
                self.on_finding(plant, finding)
        publications = self._log_alarms(super().on_tick(now_ns))
        if now_ns >= self._report_ns:
            self._report_ns = now_ns + LOG_INTERVAL_NS
            self._log_reports(now_ns)
        return publications

    def next_tick_ns(self) -> int:
        """See `FleetMonitor`; or the next check for states to store, or for a finding."""
        due_ns = super().next_tick_ns()
        return due_ns if self._states is None and not self._worker.is_busy else min(due_ns, self._poll_ns)

    def on_stop(self, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; states are stored for the last time."""
        self._worker.close()
        if self._states is not None:
            for plant in filter(self.is_worth_storing, self.plants):
                self._states.put(plant, self._monitors[plant].to_bytes())
            self._states.close()
            self._count_failures()
        return super().on_stop(now_ns)

    # --- plants and states -----------------------------------------------------------------------------------

    def _on_watched(self, plant: str, watched: bool) -> None:
        """Show a plant's token and its metrics, or withdraw them."""
        token = keys.key(plant, keys.ALIVE, NODE)
        if self.metrics is not None:
            if watched:
                self.metrics.add_plant(plant, lambda: self.alarms_of(plant))
            else:
                self.metrics.remove_plant(plant)
        log.info("watching" if watched else "no longer watching", plant=plant)
        if watched:
            self._others.check(plant)
        if watched and len(self._tokens) < MOST_TOKENS:
            self._tokens.add(token)
            self._bus.declare_token(token)
        elif token in self._tokens:
            self._tokens.remove(token)
            self._bus.undeclare_token(token)

    def _restore(self, plant: str, monitor: Monitor) -> None:
        assert self._states is not None, "only its plants are restored"
        if line := self._states.load(plant, monitor):
            log.warning(line, plant=plant)

    def _store_due(self, now_ns: int) -> None:
        """Store plants with a changed alarm, which is published by now, and some of those with new messages."""
        if self._states is None:
            return
        self._count_failures()
        due, self._changed = list(self._changed), set()
        if not self._round and not 0 <= now_ns - self._round_ns < self._every_ns:
            self._round, self._round_ns = self.plants, now_ns
        checked = 0
        while self._round and checked < MOST_STORED and self._states.has_room:
            plant, checked = self._round.pop(), checked + 1
            monitor = self._monitors.get(plant)
            if monitor is not None and monitor.memory.received != self._stored_at.get(plant):
                due.append(plant)
        for plant in filter(self.is_worth_storing, due):
            monitor = self._monitors[plant]
            self._states.put(plant, monitor.to_bytes())
            self._stored_at[plant] = monitor.memory.received

    def _count_failures(self) -> None:
        """Count failures to store states, and log each reason once."""
        for plant, why in self._states.pop_failures() if self._states is not None else ():
            self._stored_at.pop(plant, None)
            if plant in self._monitors:
                self._monitors[plant].stats.not_stored += 1
            if self._logged.get(plant) != why:
                self._logged[plant] = why
                log.warning(why, plant=plant)

    # --- logs ------------------------------------------------------------------------------------------------

    def _log_alarms(self, publications: list[Publication]) -> list[Publication]:
        """Log alarms, and mark plants with changes for storing; returns publications without empty KPIs.

        Raises:
            InputError: another monitor has claimed the states, and publishes these alarms.
        """
        kept: list[Publication] = []
        for publication in publications:
            message = publication.message
            if isinstance(message, AlarmKpis) and publication.key not in self._kpi_keys:
                if is_empty(message):
                    continue
                self._kpi_keys.add(publication.key)
            kept.append(publication)
            if isinstance(message, Alarm | Baseline):
                topic = keys.parse(publication.key)
                plant = topic.plant if topic is not None else ""
                self._changed.add(plant)
                self._poll_ns = 0  # as soon as it is published
            if isinstance(message, Alarm):
                log.info(
                    "alarm", plant=plant, alarm=message.alarm, change=message.event, by=message.by, text=message.text
                )
        if self._states is not None and any(isinstance(item.message, Alarm) for item in kept):
            self._states.claim.check()
        return kept

    def _log_reports(self, now_ns: int) -> None:
        for plant, line in self.reports(now_ns):
            log.warning(line, plant=plant)
        for plant, text in self.tracebacks():
            log.debug("traceback", plant=plant, traceback=text)
        if (refused := self._commands_refused.report(now_ns)) is not None:
            log.warning(refused)
        if (excess := self._promise_excess) is not None and not self._excess_logged:
            self._excess_logged = True
            log.warning(excess)
        if self.evictions > self._evicted_logged:
            self._evicted_logged = self.evictions
            log.warning("unverified plants without messages were evicted", so_far=self.evictions)

    @property
    def _promise_excess(self) -> str | None:
        """Text for more plants than share the false alarms of the fleet; None: there are not more."""
        promised, plants = self._fleet.false_alarms_per_day, len(self._monitors)
        if promised is None or plants <= self._fleet.divisor:
            return None
        return (
            f"the fleet has {plants} plants, and false_alarms_per_day is divided among {self._fleet.divisor}: up to "
            f"{promised * plants / self._fleet.divisor:.3g} false alarms a day may come; set [fleet] most_plants"
        )


def plants_of(config: MonitorConfig, fleet: FleetConfig) -> str:
    """Key expression of the plants of a fleet."""
    return fleet.plants or f"{keys.ROOT}/{config.plant}"


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
        InputError: the settings are inconsistent, or the folder of states cannot be used.
    """
    if config.state_file is not None:
        raise InputError("state_file holds what is known of one plant; a fleet takes [fleet] state, a folder")
    if fleet.share_per_30_days is not None:
        text = f"{fleet.false_alarms_per_day:g} false alarms a day are promised for {fleet.divisor} plants"
        log.info(text, per_plant_in_30_days=fleet.share_promise(config).false_alarms_per_30_days)
    # Inconsistent settings are refused here, and machine code is compiled before plants wait.
    prepare(load_kinds(fleet.share_promise(config), fleet), points=fleet.points)
    shard = parse_shard(fleet.shard)
    token = keys.fleet_token(plants_of(config, fleet), str(shard.of), str(shard.number), instance_name())
    with (
        serve_metrics(metrics_config, Metrics(NODE)) as metrics,
        stop_on_signals() as stop,
        join(bus_config, NODE, stop, token, uncached=UNCACHED, many_keys=True) as bus,
    ):
        if bus is None:
            return
        begin_ns, states = time.time_ns(), None  # a plant of which no state was stored yet has a history, too
        if fleet.state is not None:  # its files are read once no other monitor of the shard writes them
            folder = Path(fleet.state)
            states = retry(
                lambda: StateFolder(make_folder(folder, "--state")),
                stop.wait,
                lambda why, is_new: log.warning("waiting", node=NODE, why=why) if is_new else None,
            )
        node = FleetNode(config, fleet, bus, time.time_ns(), states, metrics, token)
        read_s = (time.time_ns() - begin_ns) / 1e9
        watch(node, bus, stop, bus_config.history_s + read_s if states is not None else 0.0)


def watch(node: FleetNode, bus: Bus, stop: StopSignal, history_s: float = 0.0) -> None:
    """Run a fleet's monitor until it is asked to stop.

    Args:
        node: the monitor.
        bus: an open bus.
        stop: ends it.
        history_s: age of the oldest earlier sample to receive.
    """
    log.info("listening", plants=node.expression)
    on_publish = node.metrics.on_publish if node.metrics is not None else None
    loop = EventLoop(
        node,
        bus,
        stop,
        drain_timeout_s=DRAIN_TIMEOUT_S,
        on_publish=on_publish,
        on_backlog=partial(setattr, node, "is_behind"),
    )
    loop.subscribe(
        keys.samples_of(node.expression),
        history_s=history_s,
        on_history_end=node.on_history_end,
        on_batch=node.on_messages,
    )
    loop.subscribe_liveliness(*node.tokens, on_token=node.on_alive)
    loop.accept_commands(*(f"{node.expression}/{keys.COMMAND}/{name}" for name in COMMANDS))
    loop.run()
