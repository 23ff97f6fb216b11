"""Monitor of one plant or of a fleet, with its stored states, liveliness tokens, commands and logs."""

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import structlog

from monitor_node.alarms.alarms import is_empty
from monitor_node.alarms.commands import CommandRateLimiter, sender_name
from monitor_node.causes import stage
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.diagnosis_worker import DiagnosisWorker
from monitor_node.fleet import ONE_PLANT, FleetConfig, FleetMonitor, PlantKind, load_kinds, parse_shard
from monitor_node.health import NODE, OtherMonitors
from monitor_node.ingest.alignment import REMEMBERED
from monitor_node.learn.training_diagnosis import read_equations
from monitor_node.state_files import RESUMED, StateStore
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmKpis, Baseline, CommandReply, Health, Incident
from reactorwatch.errors import InputError
from reactorwatch.records.write import make_folder
from reactorwatch.runtime.acl import is_query
from reactorwatch.runtime.bus import Bus
from reactorwatch.runtime.http_pages import Metrics
from reactorwatch.runtime.start import instance_name
from reactorwatch.sentences.alarm import state_word

log = structlog.get_logger()

POLL_NS = 100_000_000
"""Interval of looks for findings of diagnoses, for states to store, and of the steps of a preparation.

Such a step takes some hundredths of a second, at most a few tenths; samples are handled between two steps."""

CLAIM_NS = 1_000_000_000
"""Interval of looks at the claim of a shared folder: a monitor that was replaced while it was stalled ends at once."""

PREPARED = object()
"""Marks the end of the preparation."""


class MonitorNode(FleetMonitor):
    """Monitor of one plant, or of a fleet, as a process.

    The state of one plant is stored in a file before its alarms are published. States of a fleet are stored afterwards,
    by a thread of their own. The KPIs of a fleet's alarms are published from a plant's first alarm on: before, they
    would be empty, every minute for each plant, on a key that takes three kilobytes here and as much in the router.

    Args:
        config: settings of each plant's monitor.
        start_ns: present time.
        fleet: settings of the fleet; by default the one plant of the monitor's settings is watched.
        metrics: metrics of each plant; None: there are none.
        token: own instance token; empty: a new one, see `instance_token`.
        kinds: kinds of plants, as `load_kinds` returned them; None: they are loaded.

    Raises:
        InputError: the settings are inconsistent, or a file of the settings or the folder of states is unusable.

    Attributes:
        expression: key expression of the plants.
        is_single: True for the monitor of one plant.
        resumed: True if the monitor of one plant resumed from a stored state.
        token: instance token of this node.
        late_rows: rows up to which a sample may be late; see `SubscribeOptions`.
        preparation: steps that prepare the end of the training and the search for causes; None: there are none left.
    """

    def __init__(
        self,
        config: MonitorConfig,
        start_ns: int,
        fleet: FleetConfig = ONE_PLANT,
        metrics: Metrics | None = None,
        token: str = "",
        kinds: tuple[PlantKind, ...] | None = None,
    ) -> None:
        self._fleet, self.metrics = fleet, metrics
        self.expression = fleet.plants or f"{keys.ROOT}/{config.plant}"
        self.token = token or instance_token(config, fleet)
        self.late_rows = REMEMBERED * config.reorder_rows
        self.preparation: Iterator[None] | None = None
        self.resumed = False
        self.is_single = fleet.plants is None
        self._bus: Bus | None = None
        self._tokens: set[str] = set()
        self._worker = DiagnosisWorker()
        self._others = OtherMonitors(self.token, lambda: self._monitors)
        self._rate = CommandRateLimiter()
        self._states: StateStore | None = None
        self._every_ns = int(config.state_every_s * 1e9)
        self._changed: set[str] = set()  # plants with a changed alarm or a command since their state was stored
        self._round: list[str] = []  # plants to check for new messages
        self._stored_at: dict[str, int] = {}  # number of messages by plant when its state was stored
        self._round_ns = self._poll_ns = self._report_ns = self._claim_ns = start_ns
        self._repeated: list[Publication] = []  # a kill may have kept them from leaving the process
        self._logged: dict[str, str] = {}  # the last failure to store a plant's state
        self._kpi_keys: set[str] = set()  # keys of KPIs that are not empty
        self._evicted_logged, self._excess_logged = 0, False
        super().__init__(
            load_kinds(fleet.share_promise(config), fleet) if kinds is None else kinds,
            start_ns,
            parse_shard(fleet.shard),
            points=fleet.points or self.is_single,
            passes=InputError if self.is_single else (),
            on_watch=self._on_watched,
            diagnose=self._worker.submit,
        )
        if self.is_single and config.state_file is not None:
            self._states = StateStore(Path(config.state_file), config.plant)
        elif fleet.state is not None:
            self._states = StateStore(make_folder(Path(fleet.state), "--state"), shared=fleet.scheduler is not None)
        for plant in self._plants_at_start(config):
            self.register(plant, start_ns, verified=True, restore=self._restore)
        if self._states is not None and self._states.claim.failure:
            log.warning(self._states.claim.failure)

    # --- plants ----------------------------------------------------------------------------------------------

    def _plants_at_start(self, config: MonitorConfig) -> list[str]:
        if self.is_single:
            return [config.plant]
        stored = [] if self._states is None else self._states.plants
        return [plant for plant in stored if keys.matches(self.expression, f"{keys.ROOT}/{plant}")]

    @property
    def tokens(self) -> tuple[str, ...]:
        """Key expressions of the liveliness tokens that it subscribes to: of fleets, plants and plants' monitors."""
        monitors = keys.monitor_token(self.expression.removeprefix(f"{keys.ROOT}/"), "*")
        return keys.FLEET_TOKENS, f"{self.expression}/{keys.ALIVE}/*", monitors

    def declare_tokens(self, bus: Bus) -> None:
        """Declare the liveliness tokens of the plants, and from now on those of new ones."""
        self._bus = bus
        for plant in self._monitors:
            self._declare_token(plant)

    def _declare_token(self, plant: str) -> None:
        token = keys.key(plant, keys.ALIVE, NODE)
        if self._bus is not None and len(self._tokens) < 200:
            self._tokens.add(token)
            self._bus.declare_token(token)

    def _on_watched(self, plant: str, watched: bool) -> None:
        """Show a plant's token and its metrics, or withdraw them."""
        if not self.is_single:
            log.info("watching" if watched else "no longer watching", plant=plant)
        if watched:
            if self.metrics is not None:
                self.metrics.add_plant(plant, lambda: self.alarms_of(plant))
            self._others.check(plant)
            self._declare_token(plant)
            return
        if self.metrics is not None:
            self.metrics.remove_plant(plant)
        token = keys.key(plant, keys.ALIVE, NODE)
        if self._bus is not None and token in self._tokens:
            self._tokens.remove(token)
            self._bus.undeclare_token(token)

    # --- event loop ------------------------------------------------------------------------------------------

    def on_history_end(self) -> None:
        """End the history; that of a fleet's plant that is cut off comes once its publishers are there."""
        for monitor in self._monitors.values():
            if self.is_single or not monitor.intake.awaits_samples:
                monitor.on_history_end()

    def on_messages(self, messages: list[Encoded], now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; alarms are logged and stored."""
        return self._keep(super().on_messages(messages, now_ns), now_ns)

    def on_alive(self, token: str, is_alive: bool, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; other monitors of the plants are logged."""
        self._others.on_token(token, is_alive=is_alive)
        return super().on_alive(token, is_alive, now_ns)

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply | None, list[Publication]]:
        """See `FleetMonitor`; alarms are logged and stored; too many commands, over all plants, are refused."""
        topic = keys.parse(question.key)
        if topic is None or topic.plant not in self._monitors:
            return None, []
        monitor, refusal = self._monitors[topic.plant], self._rate.check(sender_name(question), now_ns)
        if refusal is not None:
            monitor.memory.received += 1
            monitor.intake.rejects.add("too_many_commands", refusal)
            return CommandReply(accepted=False, text=refusal), []
        reply, publications = super().on_command(question, now_ns)
        if reply is not None and reply.accepted and not is_query(question):
            self._changed.add(topic.plant)
            self._poll_ns = 0
        return reply, self._keep(publications, now_ns)

    def on_tick(self, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; a step is prepared, states are stored, and findings and notes are logged."""
        if now_ns >= self._poll_ns:
            self._poll_ns = now_ns + POLL_NS
            if self.preparation is not None and next(self.preparation, PREPARED) is PREPARED:
                self.preparation = None
            self._store_due(now_ns)
            for plant, finding in self._worker.pop_findings():
                log.info("training diagnosed", plant=plant, verdict=finding.verdict)
                self.on_finding(plant, finding)
                if finding.equations and self.is_single:
                    monitor = self._monitors[plant]
                    changed = read_equations(finding.equations, monitor.pipeline.model)
                    extended = stage.preparation(monitor.config, changed)
                    self.preparation = chain(self.preparation or (), extended)
        publications = self._keep(super().on_tick(now_ns), now_ns)
        if self.is_single or now_ns >= self._report_ns:
            self._report_ns = now_ns + 10_000_000_000
            self._log_notes()
            self._log_rejects(now_ns)
        return publications

    def next_tick_ns(self) -> int:
        """See `FleetMonitor`; or the next look for findings, for states to store or for a step of the preparation."""
        due_ns = super().next_tick_ns()
        polls = self.preparation is not None or self._states is not None or self._worker.is_busy
        return min(due_ns, self._poll_ns) if polls else due_ns

    def on_stop(self, now_ns: int) -> list[Publication]:
        """See `FleetMonitor`; states are stored for the last time."""
        self._worker.close()
        if self._states is not None:
            for monitor in self._monitors.values():
                monitor.unconfirmed = []
            self._store(self._states, self.plants)
            self._states.close()
            self._count_failures(self._states)
        return super().on_stop(now_ns)

    # --- states ----------------------------------------------------------------------------------------------

    def _restore(self, monitor: Monitor) -> None:
        """Restore a monitor from its stored state; a fleet's plant is watched without one that cannot be read."""
        if self._states is None:
            return
        try:
            line = self._states.load(monitor)
        except InputError as error:
            if self.is_single:
                self._states.close()
                raise
            line = str(error)
        if self.is_single:
            log.info(line, plant=monitor.config.plant)
            self.resumed = monitor.rows > 0
            self._repeated = monitor.unconfirmed if self.resumed else []
        elif not line.endswith(RESUMED):
            log.warning(line, plant=monitor.config.plant)

    def _store_due(self, now_ns: int) -> None:
        """Store plants with a changed alarm, which is published by now, and some of those with new messages."""
        if self._states is None:
            return
        self._count_failures(self._states)
        due, self._changed = list(self._changed), set()
        if not self._round and not 0 <= now_ns - self._round_ns < self._every_ns:
            self._round, self._round_ns = self.plants, now_ns
        checked = 0
        # half a millisecond each; with thousands of plants, each is stored less often
        while self._round and checked < 20 and self._states.has_room:
            plant, checked = self._round.pop(), checked + 1
            monitor = self._monitors.get(plant)
            if monitor is not None and monitor.memory.received != self._stored_at.get(plant):
                due.append(plant)
        self._store(self._states, due)

    def _store(self, states: StateStore, plants: list[str]) -> None:
        """Store the states of plants; that of one plant is on the disk when this returns, or could not be written."""
        for plant in plants:
            if self.is_single or self.is_worth_storing(plant):
                monitor = self._monitors[plant]
                states.put(plant, monitor.to_bytes())
                self._stored_at[plant] = monitor.memory.received
        if self.is_single and plants and not self._count_failures(states):
            self._logged.clear()

    def _count_failures(self, states: StateStore) -> int:
        """Count failures to store states, and log each reason once. A full disk must not stop the monitor."""
        failures = states.pop_failures()
        for plant, why in failures:
            self._stored_at.pop(plant, None)
            if plant in self._monitors:
                self._monitors[plant].stats.not_stored += 1
            if self._logged.get(plant) != why:
                self._logged[plant] = why
                log.warning(why, plant=plant)
        return len(failures)

    # --- publications and logs -------------------------------------------------------------------------------

    def _keep(self, publications: list[Publication], now_ns: int) -> list[Publication]:
        """Log what is published next, and store it or mark it for storing; returns it.

        Raises:
            InputError: another monitor has claimed the state, and publishes these alarms.
        """
        if self._states is not None and not 0 <= now_ns - self._claim_ns < CLAIM_NS:
            self._states.claim.check()
            self._claim_ns = now_ns
        if self._repeated:
            publications, self._repeated = self._repeated + publications, []
        if publications:
            publications = self._log(publications)
        if self.is_single:
            self._log_notes()
        if self.is_single and self._states is not None:
            (monitor,) = self._monitors.values()
            repeatable = [item for item in publications if not isinstance(item.message, Health)]
            monitor.unconfirmed = repeatable or monitor.unconfirmed
            if self._changed:
                self._changed.clear()
                self._store(self._states, self.plants)
        return publications

    def _log(self, publications: list[Publication]) -> list[Publication]:
        """Log alarms and incidents, and mark plants with changes; returns publications without a fleet's empty KPIs."""
        kept, is_checked = list[Publication](), False
        for publication in publications:
            message = publication.message
            if isinstance(message, AlarmKpis) and not self.is_single and publication.key not in self._kpi_keys:
                if is_empty(message):
                    continue
                self._kpi_keys.add(publication.key)
            kept.append(publication)
            if isinstance(message, Health) and self.is_single:
                message.waiting_for = next(iter(self._logged.values()), "")
            topic = keys.parse(publication.key) if isinstance(message, Alarm | Baseline | Incident) else None
            plant = topic.plant if topic is not None else ""
            if topic is not None:
                self._changed.add(plant)
                self._poll_ns = 0  # as soon as it is published
            if isinstance(message, Alarm):
                if self._states is not None and not is_checked:
                    self._states.claim.check()
                    is_checked = True
                log.info(
                    "alarm", plant=plant, alarm=message.alarm, change=message.event, by=message.by, text=message.text
                )
            elif isinstance(message, Incident):
                suspects = ", ".join(f"{item.cause} {item.probability:.2f}" for item in message.suspects)
                state, text = state_word(message.state), message.text
                log.info("incident", plant=plant, number=message.number, state=state, suspects=suspects, text=text)
        return kept

    def _log_notes(self) -> None:
        for plant, monitor in self._monitors.items():
            while monitor.notes:
                log.warning(monitor.notes.pop(0), plant=plant)
            while monitor.failures.tracebacks:
                log.debug("traceback", plant=plant, traceback=monitor.failures.tracebacks.pop(0))

    def _log_rejects(self, now_ns: int) -> None:
        """Log refused messages, at most once a minute for each plant, evictions and plants beyond the promise."""
        for plant, monitor in self._monitors.items():
            if (refused := monitor.intake.rejects.report(now_ns)) is not None:
                log.warning(refused, plant=plant)
        if (excess := self._fleet.describe_excess(len(self._monitors))) is not None and not self._excess_logged:
            self._excess_logged = True
            log.warning(excess)
        if self.evictions > self._evicted_logged:
            self._evicted_logged = self.evictions
            log.warning("unverified plants without messages were evicted", so_far=self.evictions)


def instance_token(config: MonitorConfig, fleet: FleetConfig) -> str:
    """New instance token of a monitor, which tells its plants and its shard to others."""
    if fleet.plants is None:
        return keys.monitor_token(config.plant, instance_name())
    shard = parse_shard(fleet.shard)
    return keys.fleet_token(fleet.plants, str(shard.of), str(shard.number), instance_name())
