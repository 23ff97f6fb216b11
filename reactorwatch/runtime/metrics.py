"""A node's counts as a page that Prometheus scrapes: the only file that imports its client (`reactorwatch[metrics]`).

The numbers are those of the newest `Health` that the node has published, with the states of its alarms and the free
space of its disk. Names keep Prometheus' conventions (https://prometheus.io/docs/practices/naming): a prefix, base
units at the end, `_total` for counters. Missing samples are a gauge: one that arrives late is missing no more, and
Prometheus takes a falling counter for a restart.

The node's loop passes each publication on (`Metrics.observe`); a scrape reads, in a thread of the server, references
that are replaced as a whole. A node of many plants has one page for all (`FleetMetrics`).
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TypeVar

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
PORT_OFFSET = {"plant": 0, "monitor": 1, "recorder": 2}
"""Offset of each node's port from that of the settings, which several nodes may share."""

MAX_PLANTS = 1000
"""Plants of a fleet on its page: a thousand are 1.5 MB, and a sixth of a second of a core at each scrape."""

COUNTERS = {
    "received": ("messages_received", "Messages received"),
    "published": ("messages_published", "Messages published"),
    "late": ("samples_late", "Samples that arrived after their row was evaluated"),
    "duplicated": ("samples_duplicated", "Repeated samples"),
    "out_of_order": ("samples_out_of_order", "Samples that arrived after newer ones"),
    "rows": ("rows", "Complete rows evaluated"),
    "incomplete_rows": ("rows_incomplete", "Rows given up because a signal was missing"),
}
"""Name without prefix and `_total`, and description, by field of `Health`."""

_STATES = {
    name: name.removeprefix("ALARM_STATE_").lower()
    for name, number in AlarmState.items()
    if number != AlarmState.ALARM_STATE_UNSPECIFIED
}


class Metrics:
    """The page of a node, a collector of Prometheus' library.

    Args:
        plant: name of the node's plant.
        node: name of the node.
        free_bytes: returns the free space of its disk; None: it writes no files.
    """

    def __init__(self, plant: str, node: str, free_bytes: Callable[[], int] | None = None) -> None:
        self._labels = {"plant": plant, "node": node}
        self._free_bytes = free_bytes
        self._health: Health | None = None
        self._by_state: Counter[int] | None = None

    def observe(self, alarms: Callable[[], Iterable[Alarm] | None] | None = None) -> Callable[[Publication], None]:
        """Return a function to be called with each publication of the node.

        Args:
            alarms: returns the node's alarms, or None if they have not changed; called in the thread of the caller.
                None: the node has no alarms.
        """

        def on_publication(publication: Publication) -> None:
            message = publication.message
            if isinstance(message, Health):
                self._health = message
            elif not isinstance(message, Alarm):
                return
            changed = alarms() if alarms is not None else None
            if changed is not None:
                self._by_state = Counter(alarm.state for alarm in changed)

        return on_publication

    def collect(self) -> "Iterator[Metric]":
        """Yield the metrics; those not known yet are left out."""
        from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily

        gauge, counter, health = GaugeMetricFamily, CounterMetricFamily, self._health
        if health is not None:
            yield self._family(InfoMetricFamily, "node", "The node", {"": {"version": health.version}})
            yield self._family(gauge, "phase", "1 for what the node does now", {health.phase: 1}, "phase")
            for name, meaning, value in (
                ("uptime_seconds", "Since the node was started", health.uptime_s),
                ("lag_seconds", "The longest from receipt to the end of the work on it", health.lag_ms / 1e3),
                ("reported_timestamp_seconds", "When the node counted this", health.time_ns / 1e9),
                ("samples_lost", "Samples whose numbers are missing so far", health.lost),
            ):
                yield self._family(gauge, name, meaning, {"": value})
            for field, (name, meaning) in COUNTERS.items():
                yield self._family(counter, name, meaning, {"": getattr(health, field)})
            for name, meaning, counts, label in (
                ("messages_refused", "Messages that could not be used", health.refused_by_reason, "reason"),
                ("failures", "Errors of this software that the node contained", health.failures, "stage"),
            ):
                yield self._family(counter, name, meaning, dict(sorted(counts.items())), label)
        if self._by_state is not None:
            by_state = {state: self._by_state[AlarmState.Value(name)] for name, state in _STATES.items()}
            yield self._family(gauge, "alarms", "Alarms in each state", by_state, "state")
        if self._free_bytes is not None:
            try:
                free = self._free_bytes()
            except OSError:  # the folder is gone: no number is better than a wrong one
                return
            yield self._family(gauge, "disk_free_bytes", "Room on the disk of the recordings", {"": free})

    def _family(
        self, kind: "Callable[..., Metric]", name: str, meaning: str, values: Mapping[str, object], label: str = ""
    ) -> "Metric":
        """A metric with its values, by the value of a label of its own if it has one."""
        family: Any = kind(f"{PREFIX}_{name}", meaning, labels=[*self._labels, *filter(None, [label])])
        for of_label, value in values.items():
            family.add_metric([*self._labels.values(), *([of_label] if label else [])], value)
        return family


class FleetMetrics:
    """The page of a node of many plants.

    Args:
        node: name of the node.
    """

    def __init__(self, node: str) -> None:
        self._node = node
        self._pages: dict[str, tuple[Metrics, Callable[[Publication], None]]] = {}  # by plant

    def add_plant(self, plant: str, alarms: Callable[[], Iterable[Alarm] | None]) -> None:
        """Add a plant to the page, unless there are `MAX_PLANTS`.

        Args:
            plant: name of the plant.
            alarms: see `Metrics.observe`.
        """
        if len(self._pages) < MAX_PLANTS:
            page = Metrics(plant, self._node)
            self._pages[plant] = page, page.observe(alarms)

    def remove_plant(self, plant: str) -> None:
        """Remove a plant from the page."""
        self._pages.pop(plant, None)

    def on_publish(self, publication: Publication) -> None:
        """Take the counts and alarm states from a publication of the node."""
        topic = keys.parse(publication.key)
        page = self._pages.get(topic.plant) if topic is not None else None
        if page is not None:
            page[1](publication)

    def collect(self) -> "Iterator[Metric]":
        """Yield each metric with the samples of all plants."""
        merged: dict[str, Metric] = {}
        for page, _ in list(self._pages.values()):
            for metric in page.collect():
                if metric.name in merged:
                    merged[metric.name].samples += metric.samples
                else:
                    merged[metric.name] = metric
        yield from merged.values()


Page = TypeVar("Page", Metrics, FleetMetrics)


@contextmanager
def serve_metrics(config: MetricsConfig, metrics: Page, node: str) -> Iterator[Page | None]:
    """Serve the page while the context lasts, if the settings name a port.

    Args:
        config: the settings.
        metrics: the page.
        node: name of the node.

    Returns:
        The page; None without a port.

    Raises:
        InputError: Prometheus' library is not installed, or the port cannot be listened at.
    """
    if config.port is None:
        yield None
        return
    port = config.port + PORT_OFFSET[node]
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
