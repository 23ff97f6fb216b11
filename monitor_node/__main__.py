"""The monitor as a process: configuration, bus, core, loop.

python -m monitor_node [settings.toml]
"""

import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from math import inf
from pathlib import Path

import structlog

from monitor_node.causes import stage
from monitor_node.charts import drift
from monitor_node.config import MonitorConfig
from monitor_node.core import COMMANDS, Monitor
from monitor_node.diagnosis_worker import DiagnosisWorker
from monitor_node.health import NODE, OtherMonitors
from monitor_node.learn.training_diagnosis import read_equations
from monitor_node.storage.state_files import StateFile
from monitor_node.watched_process import load_process
from reactorwatch.contract import keys
from reactorwatch.contract.alarm_text import state_word
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm, CommandReply, Health, Incident
from reactorwatch.errors import InputError
from reactorwatch.records.folder import make_folder
from reactorwatch.runtime.config import BusConfig, MetricsConfig
from reactorwatch.runtime.event_loop import EventLoop, stop_on_signals
from reactorwatch.runtime.metrics import Metrics, serve_metrics
from reactorwatch.runtime.node_main import main
from reactorwatch.runtime.security.command_rate import CommandRateLimiter, sender_name
from reactorwatch.runtime.start import instance_name, join, wait_ready

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
        token: its instance token; empty: a new one.

    Raises:
        InputError: a file of the settings is unusable.

    Attributes:
        resumed: True if the monitor resumed from a stored state.
        token: instance token of this monitor.
        preparation: steps that prepare the end of the training and the search for causes; None: there are none left.
    """

    def __init__(self, config: MonitorConfig, start_ns: int, token: str = "") -> None:
        config, model = load_process(config)
        super().__init__(config, start_ns, model=model)
        self._logged: dict[object, str] = {}
        self._rate = CommandRateLimiter()
        self.preparation: Iterator[None] | None = None
        self._prepare_ns = self._look_ns = start_ns
        self._worker = DiagnosisWorker()
        self.token = token or keys.monitor_token(config.plant, instance_name())
        self._others = OtherMonitors(self.token, lambda: (config.plant,))
        self._file: StateFile | None = None
        if config.state_file is not None:
            self._file = StateFile(Path(config.state_file), self, config.state_every_s)
            log.info(self._file.load())
            if self._file.claim.failure:
                log.warning(self._file.claim.failure)
        self.resumed = self.rows > 0
        self._repeated = self.unconfirmed if self.resumed else []

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
        self._others.on_token(token, is_alive=is_alive)
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
            self._file.claim.close()
        return super().on_stop(now_ns)

    def _pop_repeated(self) -> list[Publication]:
        repeated, self._repeated = self._repeated, []
        return repeated

    def _keep(self, publications: list[Publication], now_ns: int) -> None:
        """Store and log what is published next.

        Raises:
            InputError: another monitor has claimed the state, and publishes these alarms.
        """
        if self._file is not None and any(isinstance(item.message, Alarm) for item in publications):
            self._file.claim.check()
        self.unconfirmed = [item for item in publications if not isinstance(item.message, Health)] or self.unconfirmed
        for publication in publications:
            message = publication.message
            if isinstance(message, Health):
                message.waiting_for = next(iter(self._logged.values()), "")
            if isinstance(message, Alarm):
                log.info("alarm", alarm=message.alarm, change=message.event, by=message.by, text=message.text)
            if isinstance(message, Incident):
                likely = ", ".join(f"{item.cause} {item.probability:.2f}" for item in message.suspects)
                state = state_word(message.state)
                log.info("incident", number=message.number, state=state, suspects=likely, text=message.text)
        while self.notes:
            log.warning(self.notes.pop(0))
        while self.failures.tracebacks:
            log.debug("traceback", traceback=self.failures.tracebacks.pop(0))
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


def run(
    config: MonitorConfig,
    bus_config: BusConfig,
    metrics_config: MetricsConfig = MetricsConfig(),  # noqa: B008 (it is frozen)
    state: Path | None = None,
) -> None:
    """Run the monitor until SIGINT or SIGTERM.

    Args:
        config: settings of the monitor.
        bus_config: settings of the bus.
        metrics_config: settings of the metrics.
        state: folder of its files, which is made if it does not exist; None: it is there.

    Raises:
        InputError: the settings are inconsistent, or a file of the settings is unusable.
    """

    def start() -> MonitorNode:
        if state is not None:
            make_folder(state, "--state")
        return MonitorNode(config, time.time_ns(), token)

    load_process(config)  # errors in the settings are raised before waiting for a router
    token = keys.monitor_token(config.plant, instance_name())
    page = Metrics(NODE, {config.plant: lambda: node.alarms.all_alarms()})
    with (
        serve_metrics(metrics_config, page) as metrics,
        stop_on_signals() as stop,
        join(bus_config, NODE, stop, token) as bus,
    ):
        # Its files are read once no other monitor writes them.
        started = None if bus is None else wait_ready(start, bus, NODE, config.plant, stop)
        if bus is None or started is None:
            return
        node, config = started, started.config  # with what its process states
        node.preparation = chain(drift.preparation(config, wanted=True), stage.preparation(config, node.equations))
        length = config.training_length
        log.info("listening", plant=config.plant, training_min=length.minutes, training_rows=length.rows or None)
        on_publish = metrics.on_publish if metrics is not None else None
        loop = EventLoop(
            node,
            bus,
            stop,
            drain_timeout_s=DRAIN_TIMEOUT_S,
            on_publish=on_publish,
            on_backlog=partial(setattr, node, "is_behind"),
        )
        # All samples published since the state was stored, however long ago; the node skips those it knows.
        history_s = inf if node.resumed else 0.0
        loop.subscribe(
            keys.all_keys(config.plant, keys.SAMPLE), history_s=history_s, on_history_end=node.on_history_end
        )
        loop.subscribe_liveliness(*node.tokens, on_token=node.on_alive)
        loop.accept_commands(*(keys.key(config.plant, keys.COMMAND, name) for name in COMMANDS))
        bus.declare_token(keys.key(config.plant, keys.ALIVE, NODE))
        loop.run()


if __name__ == "__main__":
    sys.exit(main("monitor_node", "monitor", MonitorConfig, run))
