"""The monitor as a process: configuration, bus, core, loop.

python -m monitor_node [settings.toml]
"""

import secrets
import sys
import time
from collections.abc import Callable, Iterator
from itertools import chain
from math import inf
from pathlib import Path

import structlog

from monitor_node.baseline.training_diagnosis import read_equations
from monitor_node.config import MonitorConfig
from monitor_node.core import COMMANDS, Monitor
from monitor_node.diagnosis_worker import DiagnosisWorker
from monitor_node.health.message import NODE
from monitor_node.health.other_monitors import OtherMonitors, log_report
from monitor_node.isolation import stage
from monitor_node.stages import drift
from monitor_node.storage.alarm_file import AlarmFile
from monitor_node.storage.state_file import StateFile
from monitor_node.watched_process import load_process
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, CommandReply, Health
from reactorwatch.errors import InputError
from reactorwatch.runtime import bus_zenoh
from reactorwatch.runtime.bus import Bus
from reactorwatch.runtime.config import BusConfig, MetricsConfig
from reactorwatch.runtime.event_loop import EventLoop, stop_on_signals
from reactorwatch.runtime.metrics import Metrics, serve_metrics
from reactorwatch.runtime.node_main import main
from reactorwatch.runtime.security.command_rate import CommandRateLimiter, sender_name

log = structlog.get_logger()

PREPARE_EVERY_NS = 100_000_000
"""Interval between two steps of the preparation, some hundredths of a second each, at most a few tenths; samples are
handled between them."""

LOOK_EVERY_NS = 100_000_000
"""Interval of looks for the finding of a diagnosis."""

PREPARED = object()
"""Marks the end of the preparation."""

DRAIN_TIMEOUT_S = 0.5
"""Time without messages after which a stopping monitor has received everything."""


class MonitorNode(Monitor):
    """A monitor with its stored state and log.

    Args:
        config: settings of the monitor.
        start_ns: present time.

    Raises:
        InputError: a file of the settings is unusable.

    Attributes:
        resumed: True if the monitor resumed from a stored state.
        token: unique liveliness token of this monitor.
        preparation: steps that prepare the end of the training and the search for causes; None: there are none left.
    """

    def __init__(self, config: MonitorConfig, start_ns: int) -> None:
        config, model = load_process(config)
        super().__init__(config, start_ns, model=model)
        self._logged: dict[object, str] = {}
        self._rate = CommandRateLimiter()
        self.preparation: Iterator[None] | None = None
        self._prepare_ns = self._look_ns = start_ns
        self._worker = DiagnosisWorker()
        self.token = keys.monitor_token(config.plant, f"{start_ns:020d}-{secrets.token_hex(4)}")
        self._others = OtherMonitors(self.token, lambda: (config.plant,))
        paths = [Path(name) for name in (config.alarm_state_file, config.state_file) if name is not None]
        if len({path.resolve() for path in paths}) < len(paths):
            raise InputError(f"state_file and alarm_state_file must be two files, got {paths[0]} for both")
        self._alarm_file: AlarmFile | None = None
        if config.alarm_state_file is not None:
            self._alarm_file = AlarmFile(Path(config.alarm_state_file), self)
        self._file: StateFile | None = None
        if config.state_file is not None:
            self._file = StateFile(Path(config.state_file), self, config.state_every_s)
            log.info(self._file.load())
        self.resumed = self.rows > 0
        self._repeated = self.unconfirmed if self.resumed else []
        if self._alarm_file is not None:
            # The state's alarms belong to its rows; but the alarms of a state that was aside are older than the file.
            line = self._alarm_file.load(
                is_newest=not self.resumed or (self._file is not None and self._file.was_aside)
            )
            if line is not None:
                log.warning(line)

    @property
    def tokens(self) -> tuple[str, ...]:
        """Key expressions of the liveliness tokens that it subscribes to: of the plant's monitors, and of fleets."""
        return keys.monitor_token(self.config.plant, "*"), keys.FLEET_TOKENS

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """See `Monitor`; alarms are stored and logged."""
        publications = self._pop_repeated() + super().on_message(message, now_ns)
        if self.awaits_diagnosis and not self._worker.is_busy and (job := self.diagnosis_job) is not None:
            self._worker.submit(self.config.plant, job)
        self._keep(publications, now_ns)
        return publications

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        """See `Monitor`; alarms are stored before the reply, and logged; too many commands are refused."""
        refusal = self._rate.check(sender_name(question), now_ns)
        if refusal is not None:
            self.memory.received += 1
            self.rejects.add("too_many_commands", refusal)
            return CommandReply(accepted=False, text=refusal), []
        reply, publications = super().on_command(question, now_ns)
        self._keep(publications, now_ns)
        return reply, publications

    def on_alive(self, token: str, is_alive: bool, now_ns: int) -> list[Publication]:
        """Log that another monitor of the plant, or a fleet with the plant, was noticed or has gone."""
        log_report(self._others.on_token(token, is_alive=is_alive))
        return []

    def on_tick(self, now_ns: int) -> list[Publication]:
        """See `Monitor`; rejects are logged at most once a minute; failed storing is retried; a step is prepared."""
        if self.preparation is not None and now_ns >= self._prepare_ns:
            self._prepare_ns = now_ns + PREPARE_EVERY_NS
            if next(self.preparation, PREPARED) is PREPARED:
                self.preparation = None
        if self._worker.is_busy and now_ns >= self._look_ns:
            self._look_ns = now_ns + LOOK_EVERY_NS
            for _, finding in self._worker.pop_findings():
                log.info("training diagnosed", plant=self.config.plant, verdict=finding.verdict)
                self.on_finding(finding)
                if finding.equations:
                    extended = stage.preparation(self.config, read_equations(finding.equations))
                    self.preparation = chain(self.preparation or (), extended)
        report = self.rejects.report(now_ns)
        if report is not None:
            log.warning(report)
        publications = self._pop_repeated() + super().on_tick(now_ns)
        self._keep(publications, now_ns)
        return publications

    def next_tick_ns(self) -> int:
        """See `Monitor`; or the time to store the state, to prepare the next step, or to look for a finding."""
        stored_ns = None if self._file is None else self._file.due_ns()
        prepared_ns = None if self.preparation is None else self._prepare_ns
        look_ns = self._look_ns if self._worker.is_busy else None
        return min(item for item in (super().next_tick_ns(), stored_ns, prepared_ns, look_ns) if item is not None)

    def on_stop(self, now_ns: int) -> list[Publication]:
        """See `Monitor`; the state is stored for the last time."""
        self._worker.close()
        self.unconfirmed = []
        if self._file is not None:
            self._try(self._file.store)
        return super().on_stop(now_ns)

    def _pop_repeated(self) -> list[Publication]:
        repeated, self._repeated = self._repeated, []
        return repeated

    def _keep(self, publications: list[Publication], now_ns: int) -> None:
        self.unconfirmed = [item for item in publications if not isinstance(item.message, Health)] or self.unconfirmed
        for publication in publications:
            alarm = publication.message
            if isinstance(alarm, Alarm):
                likely = [f"{item.cause} {item.probability:.2f}" for item in alarm.suspects]
                log.info(
                    "alarm",
                    alarm=alarm.alarm,
                    change=alarm.event,
                    by=alarm.by,
                    text=alarm.text,
                    suspects=", ".join(likely),
                )
        while self.notes:
            log.warning(self.notes.pop(0))
        while self.failures.tracebacks:
            log.debug("traceback", traceback=self.failures.tracebacks.pop(0))
        if self._alarm_file is not None:
            self._try(self._alarm_file.store)
        if self._file is not None and self._file.is_due(now_ns):
            self._try(self._file.store)

    def _try(self, store: Callable[[], None]) -> None:
        """Store; log a failure once. A full disk must not stop the monitor: the next call retries."""
        try:
            store()
        except InputError as error:
            if str(error) != self._logged.get(store):
                self._logged[store] = str(error)
                log.warning(str(error))
        else:
            self._logged.pop(store, None)


def declare_tokens(node: MonitorNode, bus: Bus) -> None:
    """Declare the liveliness tokens of the plant's monitor."""
    bus.declare_token(keys.key(node.config.plant, keys.ALIVE, NODE))
    bus.declare_token(node.token)


def run(
    config: MonitorConfig,
    bus_config: BusConfig,
    metrics_config: MetricsConfig = MetricsConfig(),  # noqa: B008 (it is frozen)
) -> None:
    """Run the monitor until SIGINT or SIGTERM.

    Args:
        config: settings of the monitor.
        bus_config: settings of the bus.
        metrics_config: settings of the metrics.

    Raises:
        InputError: the settings are inconsistent, or a file of the settings is unusable.
    """
    node = MonitorNode(config, time.time_ns())
    config = node.config
    node.preparation = chain(drift.preparation(config, wanted=True), stage.preparation(config, node.equations))
    page = Metrics(NODE, {config.plant: node.alarms.all_alarms})
    with serve_metrics(metrics_config, page) as metrics, stop_on_signals() as stop:
        bus = bus_zenoh.connect(bus_config, NODE, stop)
        if bus is None:
            return
        try:
            length = config.training_length
            log.info("listening", plant=config.plant, training_min=length.minutes, training_rows=length.rows or None)
            on_publish = metrics.on_publish if metrics is not None else None
            loop = EventLoop(node, bus, stop, drain_timeout_s=DRAIN_TIMEOUT_S, on_publish=on_publish)
            # All samples published since the state was stored, however long ago; the node skips those it knows.
            history_s = inf if node.resumed else 0.0
            loop.subscribe(
                keys.all_keys(config.plant, keys.SAMPLE), history_s=history_s, on_history_end=node.on_history_end
            )
            loop.subscribe_liveliness(*node.tokens, on_token=node.on_alive)
            loop.accept_commands(*(keys.key(config.plant, keys.COMMAND, name) for name in COMMANDS))
            declare_tokens(node, bus)
            loop.run()
        finally:
            bus.close()


if __name__ == "__main__":
    sys.exit(main("monitor_node", "monitor", MonitorConfig, run))
