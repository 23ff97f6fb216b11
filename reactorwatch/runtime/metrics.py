"""What a node counts, as a page that Prometheus scrapes: the only file that knows of it (`reactorwatch[metrics]`).

The numbers are those of the newest `Health` that the node has published, with the states of its alarms and the room on
its disk. Names keep Prometheus' conventions (https://prometheus.io/docs/practices/naming): a prefix, base units at the
end, `_total` for what only ever grows. Samples that are missing are a gauge: one that turns up late is missing no more,
and a counter that falls is taken for a restart.

The loop of the node tells what is published (`Metrics.of`); a scrape reads it in a thread of the server's own,
from references that are replaced as a whole. A node of many plants has one page of all (`FleetMetrics`).
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Protocol, TypeVar

import structlog

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Health
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import MetricsConfig

if TYPE_CHECKING:
    from prometheus_client import Metric

log = structlog.get_logger()

PREFIX = "reactorwatch"
PORT_AFTER = {"plant": 0, "monitor": 1, "recorder": 2}
"""Where each node's page is, counted from the port of the settings, which may be those of all."""

MOST_SHOWN = 1000
"""Plants of a fleet that are on its page: a thousand are 1.5 MB, and a sixth of a second of a core at each scrape."""

COUNTERS = {
    "received": ("messages_received", "Messages that came"),
    "published": ("messages_published", "Messages that were published"),
    "late": ("samples_late", "Samples that came after their row had been judged"),
    "duplicated": ("samples_duplicated", "Samples that came again"),
    "out_of_order": ("samples_out_of_order", "Samples that came after younger ones"),
    "rows": ("rows", "Complete rows that were judged"),
    "incomplete_rows": ("rows_incomplete", "Rows that were given up because a signal was missing"),
}
"""By field of `Health`: the name without prefix and `_total`, and what it counts."""

_STATES = {
    name: name.removeprefix("ALARM_STATE_").lower()
    for name, number in AlarmState.items()
    if number != AlarmState.ALARM_STATE_UNSPECIFIED
}


def port_of(config: MetricsConfig, node: str) -> int | None:
    """The port of a node's page; None: it has none."""
    return None if config.port is None else config.port + PORT_AFTER[node]


class Metrics:
    """The page, as Prometheus' library asks for it.

    Args:
        plant: that the node is of.
        node: its name.
        free_bytes: the room on its disk; None: it writes nothing.
    """

    def __init__(self, plant: str, node: str, free_bytes: Callable[[], int] | None = None) -> None:
        self._labels = {"plant": plant, "node": node}
        self._free_bytes = free_bytes
        self._health: Health | None = None
        self._by_state: Counter[int] | None = None

    def of(self, alarms: Callable[[], Iterable[Alarm] | None] | None = None) -> Callable[[Publication], None]:
        """What is to be told of each thing that the node publishes.

        Args:
            alarms: the node's alarms as they are, asked for in the thread that tells; it returns None if they are as
                they were. None: it has none.
        """

        def published(publication: Publication) -> None:
            message = publication.message
            if isinstance(message, Health):
                self._health = message
            elif not isinstance(message, Alarm):
                return
            found = alarms() if alarms is not None else None
            if found is not None:
                self._by_state = Counter(alarm.state for alarm in found)

        return published

    def collect(self) -> "Iterator[Metric]":
        """The page; what is not known yet is left out."""
        from prometheus_client.metrics_core import GaugeMetricFamily

        if self._health is not None:
            yield from self._of_health(self._health)
        if self._by_state is not None:
            names = [*self._labels, "state"]
            gauge = GaugeMetricFamily(f"{PREFIX}_alarms", "Alarms in each state", labels=names)
            for name, state in _STATES.items():
                gauge.add_metric([*self._labels.values(), state], self._by_state[AlarmState.Value(name)])
            yield gauge
        if self._free_bytes is not None:
            try:
                free = self._free_bytes()
            except OSError:  # the folder is gone: no number is better than a wrong one
                return
            yield self._gauge("disk_free_bytes", "Room on the disk of the recordings", free)

    def _of_health(self, health: Health) -> "Iterator[Metric]":
        from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily

        names, values = list(self._labels), list(self._labels.values())
        info = InfoMetricFamily(f"{PREFIX}_node", "The node", labels=names)
        info.add_metric(values, {"version": health.version})
        yield info
        phase = GaugeMetricFamily(f"{PREFIX}_phase", "1 for what the node does now", labels=[*names, "phase"])
        phase.add_metric([*values, health.phase], 1)
        yield phase
        yield self._gauge("uptime_seconds", "Since the node was started", health.uptime_s)
        yield self._gauge("lag_seconds", "The longest from receipt to the end of the work on it", health.lag_ms / 1e3)
        yield self._gauge("reported_timestamp_seconds", "When the node counted this", health.time_ns / 1e9)
        yield self._gauge("samples_lost", "Samples whose numbers are missing so far", health.lost)
        for field, (name, meaning) in COUNTERS.items():
            counter = CounterMetricFamily(f"{PREFIX}_{name}", meaning, labels=names)
            counter.add_metric(values, getattr(health, field))
            yield counter
        refused = CounterMetricFamily(
            f"{PREFIX}_messages_refused", "Messages that could not be used", labels=[*names, "reason"]
        )
        for reason, count in sorted(health.refused_by_reason.items()):
            refused.add_metric([*values, reason], count)
        yield refused
        failures = CounterMetricFamily(
            f"{PREFIX}_failures", "Errors of this software that the node contained", labels=[*names, "stage"]
        )
        for stage, count in sorted(health.failures.items()):
            failures.add_metric([*values, stage], count)
        yield failures

    def _gauge(self, name: str, meaning: str, value: float) -> "Metric":
        from prometheus_client.metrics_core import GaugeMetricFamily

        gauge = GaugeMetricFamily(f"{PREFIX}_{name}", meaning, labels=list(self._labels))
        gauge.add_metric(list(self._labels.values()), value)
        return gauge


class FleetMetrics:
    """The pages of many plants as one.

    Args:
        node: its name.
    """

    def __init__(self, node: str) -> None:
        self._node = node
        self._pages: dict[str, tuple[Metrics, Callable[[Publication], None]]] = {}  # by plant

    def watch(self, plant: str, alarms: Callable[[], Iterable[Alarm] | None]) -> None:
        """From now on a plant is on the page, if there are not too many.

        Args:
            plant: its name.
            alarms: as for `Metrics.of`.
        """
        if len(self._pages) < MOST_SHOWN:
            page = Metrics(plant, self._node)
            self._pages[plant] = page, page.of(alarms)

    def leave(self, plant: str) -> None:
        """A plant is on the page no longer."""
        self._pages.pop(plant, None)

    def published(self, publication: Publication) -> None:
        """To be told of each thing that the node publishes."""
        topic = keys.parse(publication.key)
        found = self._pages.get(topic.plant) if topic is not None else None
        if found is not None:
            found[1](publication)

    def collect(self) -> "Iterator[Metric]":
        """The page: of each metric all plants together."""
        together: dict[str, Metric] = {}
        for page, _ in list(self._pages.values()):
            for metric in page.collect():
                if metric.name in together:
                    together[metric.name].samples += metric.samples
                else:
                    together[metric.name] = metric
        yield from together.values()


class _Page(Protocol):
    def collect(self) -> "Iterator[Metric]": ...


Page = TypeVar("Page", bound=_Page)


@contextmanager
def served(config: MetricsConfig, metrics: Page, node: str) -> Iterator[Page | None]:
    """Serve the page while the context lasts, if the settings ask for it.

    Args:
        config: the settings.
        metrics: the page.
        node: whose it is.

    Returns:
        The page; None if it is not asked for.

    Raises:
        InputError: Prometheus' library is not installed, or the port cannot be listened at.
    """
    port = port_of(config, node)
    if port is None:
        yield None
        return
    try:
        from prometheus_client import CollectorRegistry, ProcessCollector, start_http_server
    except ImportError as missing:
        raise InputError("[metrics] needs prometheus-client: pip install 'reactorwatch[metrics]'") from missing
    registry = CollectorRegistry()
    registry.register(metrics)
    ProcessCollector(registry=registry)
    try:
        server, thread = start_http_server(port, config.address, registry)
    except OSError as error:
        raise InputError(
            f"[metrics] port {config.port}: the {node} cannot listen at {config.address}:{port}: {error.strerror}"
        ) from error
    log.info("metrics", page=f"http://{config.address}:{port}/metrics")
    try:
        yield metrics
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
