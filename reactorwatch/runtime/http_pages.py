"""Pages on HTTP: a node's counts for Prometheus, and the guard of pages of this machine.

This is the only file that imports Prometheus' client (`reactorwatch[metrics]`). The numbers are those of the newest
`Health` that the node has published, with the states of its alarms and the free space of its disk. Names keep
Prometheus' conventions (https://prometheus.io/docs/practices/naming): a prefix, base units at the end, `_total` for
counters. Missing samples are a gauge: one that arrives late is missing no more, and Prometheus takes a falling counter
for a restart.

The node's loop passes each publication on (`Metrics.on_publish`); a scrape reads, in a thread of the server,
references that are replaced as a whole. A node of many plants has one page for all.
A port that cannot be listened at stops no node: it is tried again until it can be, and health says so.

A guarded page answers a request that names this machine as its host, and is complete in time. A web page of another
origin may have its own name point to this machine's address (DNS rebinding); the browser then reads local pages for it,
and names that origin in the `Host` header (RFC 9110, section 7.2). A connection whose request does not come in time is
closed, so that half-open ones do not add up.
"""

import re
import socket
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from ipaddress import ip_address
from socketserver import BaseRequestHandler, ThreadingTCPServer
from threading import Event, Thread, Timer
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeAlias
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

import structlog

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Health
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import MetricsConfig
from reactorwatch.runtime.event_loop import retry

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

GAUGES = (
    ("uptime_seconds", "Since the node was started", "uptime_s", 1),
    ("lag_seconds", "The longest from receipt to the end of the work on it", "lag_ms", 1e3),
    ("reported_timestamp_seconds", "When the node counted this", "time_ns", 1e9),
    ("samples_lost", "Samples whose numbers are missing so far", "lost", 1),
)
"""Name without prefix, description, field of `Health`, and by what it is divided."""

_STATES = {
    name: name.removeprefix("ALARM_STATE_").lower()
    for name, number in AlarmState.items()
    if number != AlarmState.ALARM_STATE_UNSPECIFIED
}


Alarms: TypeAlias = Callable[[], Iterable[Alarm] | None] | None
NO_PLANTS: Mapping[str, Alarms] = MappingProxyType({})


@dataclass
class _Plant:
    """A plant on the page: its alarms, as the node returns them, and what the node has published of it."""

    alarms: Alarms
    health: Health | None = None
    by_state: Counter[int] | None = None


class Metrics:
    """The page of a node of one plant or many, a collector of Prometheus' library.

    Args:
        node: name of the node.
        plants: by name of a plant, a function that returns its alarms, or None if they have not changed; it is called
            in the thread of the caller. None: the node has no alarms.
        free_bytes: returns the free space of its disk; None: it writes no files.

    Attributes:
        trouble: why the page is not served at the moment; empty: it is.
    """

    def __init__(
        self, node: str, plants: Mapping[str, Alarms] = NO_PLANTS, free_bytes: Callable[[], int] | None = None
    ) -> None:
        self.node, self.trouble = node, ""
        self._free_bytes = free_bytes
        self._plants = {plant: _Plant(alarms) for plant, alarms in plants.items()}

    def add_plant(self, plant: str, alarms: Alarms) -> None:
        """Add a plant to the page, with a function as in `plants`, unless there are `MAX_PLANTS`."""
        if len(self._plants) < MAX_PLANTS:
            self._plants[plant] = _Plant(alarms)

    def remove_plant(self, plant: str) -> None:
        """Remove a plant from the page."""
        self._plants.pop(plant, None)

    def on_publish(self, publication: Publication) -> None:
        """Take the counts and alarm states from a publication of the node; its health says why there is no page."""
        message = publication.message
        if isinstance(message, Health) and self.trouble and not message.waiting_for:
            message.waiting_for = self.trouble
        if not isinstance(message, Health | Alarm):
            return
        topic = keys.parse(publication.key)
        plant = self._plants.get(topic.plant) if topic is not None else None
        if plant is None:
            return
        if isinstance(message, Health):
            plant.health = message
        changed = plant.alarms() if plant.alarms is not None else None
        if changed is not None:
            plant.by_state = Counter(alarm.state for alarm in changed)

    def collect(self) -> "Iterator[Metric]":
        """Yield each metric with the values of all plants; those not known yet are left out."""
        from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily

        gauge, counter, plants = GaugeMetricFamily, CounterMetricFamily, list(self._plants.items())
        healths = [(name, plant.health) for name, plant in plants if plant.health is not None]
        if healths:
            versions = [(plant, "", {"version": health.version}) for plant, health in healths]
            yield self._family(InfoMetricFamily, "node", "The node", versions)
            phases = [(plant, health.phase, 1) for plant, health in healths]
            yield self._family(gauge, "phase", "1 for what the node does now", phases, "phase")
            for name, meaning, field, scale in GAUGES:
                values = [(plant, "", getattr(health, field) / scale) for plant, health in healths]
                yield self._family(gauge, name, meaning, values)
            for field, (name, meaning) in COUNTERS.items():
                yield self._family(counter, name, meaning, [(plant, "", getattr(it, field)) for plant, it in healths])
            for name, meaning, field, label in (
                ("messages_refused", "Messages that could not be used", "refused_by_reason", "reason"),
                ("failures", "Errors of this software that the node contained", "failures", "stage"),
            ):
                counts = [(plant, *item) for plant, it in healths for item in sorted(getattr(it, field).items())]
                yield self._family(counter, name, meaning, counts, label)
        states = [
            (name, state, plant.by_state[AlarmState.Value(word)])
            for name, plant in plants
            if plant.by_state is not None
            for word, state in _STATES.items()
        ]
        if states:
            yield self._family(gauge, "alarms", "Alarms in each state", states, "state")
        if self._free_bytes is not None:
            try:
                free = self._free_bytes()
            except OSError:  # the folder is gone: no number is better than a wrong one
                return
            room = [(plant, "", free) for plant, _ in plants]
            yield self._family(gauge, "disk_free_bytes", "Room on the disk of the recordings", room)

    def _family(
        self, kind: Any, name: str, meaning: str, values: Iterable[tuple[str, str, object]], label: str = ""
    ) -> "Metric":
        """A metric with its values, each by its plant and by the value of a label of its own if it has one."""
        family = kind(f"{PREFIX}_{name}", meaning, labels=["plant", "node", *filter(None, [label])])
        for plant, own, value in values:
            family.add_metric([plant, self.node, *([own] if label else [])], value)
        metric: Metric = family
        return metric


@contextmanager
def serve_metrics(config: MetricsConfig, metrics: Metrics) -> Iterator[Metrics | None]:
    """Serve the page while the context lasts, if the settings name a port.

    Args:
        config: the settings.
        metrics: the page.

    Returns:
        The page; None without a port.

    Raises:
        InputError: Prometheus' library is not installed.
    """
    if config.port is None:
        yield None
        return
    port = config.port + PORT_OFFSET[metrics.node]
    address = f"{config.address}:{port}"
    try:
        from prometheus_client import CollectorRegistry, ProcessCollector, make_wsgi_app
    except ImportError as missing:
        raise InputError("[metrics] needs prometheus-client: pip install 'reactorwatch[metrics]'") from missing
    registry = CollectorRegistry()
    registry.register(metrics)
    ProcessCollector(registry=registry)
    tried, ended = Event(), Event()

    def serve() -> None:
        served = retry(
            lambda: PageServer((config.address, port), guard_application(make_wsgi_app(registry))),
            ended.wait,
            on_failure,
            lambda error: isinstance(error, OSError),
        )
        if served is None:
            return
        metrics.trouble = ""
        log.info("metrics", page=f"http://{address}/metrics")
        tried.set()
        with served.serving():
            ended.wait()

    def on_failure(why: str, is_new: bool) -> None:
        metrics.trouble = f"[metrics] port {config.port}: the {metrics.node} cannot listen at {address}: {why}"
        if is_new:
            log.warning(metrics.trouble)
        tried.set()

    server_thread = Thread(target=serve, name="metrics")
    server_thread.start()
    tried.wait()
    try:
        yield metrics
    finally:
        ended.set()
        server_thread.join()


REQUEST_TIMEOUT_S = 10.0  # so that half-open connections do not add up
MAX_HEAD = 1 << 16
"""Bytes of the head of a request; http.client has the same limit for a line."""
BLOCK = 1 << 16  # bytes that are passed on at once
PRIVATE = ("local", "localhost", "internal", "lan", "home.arpa")
"""Ends of names that only a local network resolves (RFC 6761, 6762, 8375; ICANN reserved `internal` in 2024)."""
STATUS = "421 Misdirected Request"
REFUSAL = "this page answers to the address or the name of this machine, not to the host %s"
_HOST = re.compile(rb"\r\nhost:[ \t]*([^\r\n]*?)[ \t]*(?=\r\n)", re.IGNORECASE)
_PORT = re.compile(r":\d*$")


def is_own_host(header: str) -> bool:
    """True if a `Host` header cannot be a name that somebody else has registered.

    >>> [is_own_host(host) for host in ("127.0.0.1:9000", "[::1]:9000", "monitor:9101", "rig.local", "evil.example")]
    [True, True, True, True, False]
    """
    name = _PORT.sub("", header).rstrip(".").lower()
    with suppress(ValueError):
        return bool(ip_address(name.strip("[]")))
    is_private = "." not in name or name.endswith(tuple(f".{end}" for end in PRIVATE))
    return bool(name) and (is_private or name in _own_names())


@cache
def _own_names() -> tuple[str, ...]:
    return socket.gethostname().lower(), socket.getfqdn().lower()


Respond = Callable[..., Iterable[bytes]]


def guard_application(application: Respond) -> Respond:
    """A WSGI application that refuses requests to other hosts, in front of another."""

    def respond(environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
        host = environ.get("HTTP_HOST", "")
        if is_own_host(host):
            return application(environ, start_response)
        start_response(STATUS, [("Content-Type", "text/plain; charset=utf-8")])
        return [f"{REFUSAL % ascii(host)}\n".encode()]

    return respond


class _Connection(BaseRequestHandler):
    """A connection to a guarded page: the head of the first request is checked, then all is passed on."""

    server: "GuardedPort"

    def handle(self) -> None:
        """See `BaseRequestHandler`."""
        head = _read_head(self.request)
        found = _HOST.findall(head)
        host = found[0].decode("latin-1") if len(found) == 1 else ""
        if not is_own_host(host):
            text = f"{REFUSAL % ascii(host)}\n"
            answer = f"HTTP/1.1 {STATUS}\r\nContent-Length: {len(text)}\r\nConnection: close\r\n\r\n{text}"
            with suppress(OSError):  # the other side has gone
                self.request.sendall(answer.encode())
            return
        with suppress(OSError), socket.create_connection((LOOPBACK, self.server.target)) as page:
            page.sendall(head)
            backwards = Thread(target=_pass_on, args=(page, self.request), daemon=True)
            backwards.start()
            _pass_on(self.request, page)
            backwards.join()


class _Server(ThreadingTCPServer):
    """A server with a thread for each connection."""

    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, address: tuple[str, int], handler: type[BaseRequestHandler]) -> None:
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        super().__init__(address, handler)

    @contextmanager
    def serving(self) -> Iterator[None]:
        """Serve while the context lasts."""
        thread = Thread(target=self.serve_forever, name="pages", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self.shutdown()
            self.server_close()
            thread.join()


class _PageHandler(WSGIRequestHandler):
    """A request of a page, whose connection is closed where it is not complete in time."""

    def setup(self) -> None:
        """See `BaseRequestHandler`."""
        self._overdue = Timer(REQUEST_TIMEOUT_S, _close, (self.request,))
        self._overdue.start()
        super().setup()

    def finish(self) -> None:
        """See `BaseRequestHandler`."""
        self._overdue.cancel()
        super().finish()

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log nothing."""


class PageServer(_Server, WSGIServer):
    """A server of a WSGI application.

    Args:
        address: address and port to listen at.
        application: the application.
    """

    def __init__(self, address: tuple[str, int], application: Respond) -> None:
        super().__init__(address, _PageHandler)
        self.set_app(application)


class GuardedPort(_Server):
    """A port that leads to a page on a port of the loopback address, for requests that name this machine.

    A browser has connections of their own for each host, so the first request of a connection names the host of all.

    Args:
        address: address to listen at.
        port: port to listen at.
        target: port of the page.
    """

    def __init__(self, address: str, port: int, target: int) -> None:
        self.target = target
        super().__init__((address, port), _Connection)


def _read_head(connection: socket.socket) -> bytes:
    """The head of a request, and what came with it; cut where it is too long, or not complete in time."""
    overdue = Timer(REQUEST_TIMEOUT_S, _close, (connection,))
    overdue.start()
    head = b""
    try:
        while b"\r\n\r\n" not in head and len(head) < MAX_HEAD and (data := connection.recv(BLOCK)):
            head += data
    except OSError:  # it was closed by either side
        return b""
    finally:
        overdue.cancel()
    return head


def _close(connection: socket.socket) -> None:
    """End a connection in both directions, also for a thread that waits for it."""
    with suppress(OSError):  # it has ended
        connection.shutdown(socket.SHUT_RDWR)


def _pass_on(source: socket.socket, sink: socket.socket) -> None:
    """Pass all bytes on until one side ends, and then end the other."""
    with suppress(OSError):
        while data := source.recv(BLOCK):
            sink.sendall(data)
    _close(sink)


LOOPBACK = "127.0.0.1"


def free_port() -> int:
    """A free TCP port of the loopback address, reserved as by `reserve_port`."""
    return reserve_port(0)


def reserve_port(port: int) -> int:
    """Reserve a port of the loopback address; returns it.

    A free port can be another process's before it is listened at: the system assigns the same ports to all processes
    that ask for any port, and to the near ends of connections. But a port whose listener has just closed a connection
    is in TIME-WAIT for a minute (RFC 9293, section 3.3.2): it can be bound by number with SO_REUSEADDR, as routers and
    viewers do, and is not assigned to a process that asks for any port.

    Args:
        port: the port; 0: any.

    Raises:
        OSError: another process listens at the port.
    """
    with socket.create_server((LOOPBACK, port)) as server:
        number: int = server.getsockname()[1]
        with socket.create_connection((LOOPBACK, number)) as near:
            far, _ = server.accept()
            far.close()  # the side that closes first is in TIME-WAIT
            near.recv(1)
    return number


def free_endpoint() -> str:
    """A router's address with a free port."""
    return f"tcp/{LOOPBACK}:{free_port()}"
