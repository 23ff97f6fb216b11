"""Connections to the bus, its router, and the log of messages that the router's access rules refuse."""

import ctypes
import json
import os
import re
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from errno import EACCES, EAGAIN, EPERM
from pathlib import Path
from select import select
from typing import Any

import structlog
import zenoh

from reactorwatch.errors import InputError
from reactorwatch.runtime.bus_zenoh.bus import ZenohBus
from reactorwatch.runtime.bus_zenoh.messages import first_line
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal, retry

log = structlog.get_logger()

STUCK_S = 1.0
LEASE_S = 10.0
"""Time without any sign of a client after which a router drops it, with its liveliness tokens."""

_TLS = "transport/link/tls"
_ROUTER_FILES = ("root_ca_certificate", "listen_certificate", "listen_private_key")
"""Keys of a router's TLS settings whose values are files."""

_SHARED_MEMORY = "transport/shared_memory/enabled"
_TRANSPORT = {
    "transport/link/tx/queue/congestion_control/block/wait_before_close": round(STUCK_S * 1e6),
    "transport/link/tx/lease": round(LEASE_S * 1e3),
    _SHARED_MEMORY: False,
}
"""Zenoh passes messages of more than 3 kB in shared memory. A session keeps the 18 MB of a process that has ended, and
2 MB beside it, for as long as it runs: each restart of a process would take 20 MB in all others."""
_RETRY = {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 1.5}


def connect(
    config: BusConfig, node: str, stop: StopSignal, *, uncached: Collection[str] = (), many_keys: bool = False
) -> ZenohBus | None:
    """Connect to the bus as a client; wait for its router as long as it takes.

    Args:
        config: address of the router.
        node: name of the waiting node, for the log.
        stop: ends the wait.
        uncached: kinds published without cache and number: those repeated again and again for thousands of plants. A
            subscriber that is cut off misses them.
        many_keys: publish, and show tokens, from a second session, because a node publishes on keys of hundreds of
            plants: a session searches its own for each message that arrives (a hundred make it four times slower).

    Returns:
        The open bus; None if a stop was requested before a router was there.

    Raises:
        InputError: Zenoh does not understand the endpoint.
    """
    client = _client(config)
    release_large_blocks()

    def on_failure(reason: str, is_new: bool) -> None:
        if is_new:
            log.info("waiting for a router", node=node, endpoint=config.endpoint, why=first_line(reason))

    def attempt() -> ZenohBus:
        session = zenoh.open(client)
        return ZenohBus(session, config, uncached, zenoh.open(client) if many_keys else None)

    bus = retry(attempt, stop.wait, on_failure, lambda error: isinstance(error, zenoh.ZError))
    if bus is not None:
        log.info("connected", node=node, endpoint=config.endpoint)
    return bus


def connect_now(config: BusConfig) -> ZenohBus:
    """Connect to the bus as a client, once.

    Raises:
        ConnectionError: the router is not there, or refuses the client; with Zenoh's text.
        InputError: Zenoh does not understand the endpoint.
    """
    try:
        return ZenohBus(zenoh.open(_client(config)), config)
    except zenoh.ZError as error:
        raise ConnectionError(first_line(error)) from error


def _client(config: BusConfig) -> zenoh.Config:
    settings = {
        "mode": "client",
        "connect/endpoints": [config.endpoint],
        "connect/retry": _RETRY,
        "connect/timeout_ms": 0,
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,  # they give the age of a message
        **_TRANSPORT,
    }
    if config.ca is not None:
        settings |= {
            f"{_TLS}/root_ca_certificate": config.ca,
            f"{_TLS}/connect_certificate": config.certificate,
            f"{_TLS}/connect_private_key": config.key,
            f"{_TLS}/enable_mtls": True,
            f"{_TLS}/verify_name_on_connect": True,
            f"{_TLS}/close_link_on_expiration": True,
        }
    return _validate(settings, config.endpoint)


def router(config: BusConfig) -> ZenohBus:
    """Run the router in this process until the bus is closed.

    Raises:
        InputError: the endpoint is malformed or taken, or needs a router's certificate.
    """
    if config.ca is not None:
        raise InputError(
            f"no router can listen at {config.endpoint!r} with the certificate of a node; "
            "name the site with --site, or start its router: `reactorwatch router SITE/router/router.json5`"
        )
    settings = {
        "mode": "router",
        "listen/endpoints": [config.endpoint],
        "listen/timeout_ms": 0,
        "listen/exit_on_failure": True,
        "connect/endpoints": list(config.routers),
        "connect/retry": _RETRY,
        "connect/timeout_ms": {"router": -1},
        "connect/exit_on_failure": {"router": False},
        "scouting/multicast/enabled": False,
        **_TRANSPORT,
    }
    release_large_blocks()
    try:
        session = zenoh.open(_validate(settings, config.endpoint))
    except zenoh.ZError as error:
        raise InputError(
            f"no router can listen at {config.endpoint!r}: {first_line(error)}; "
            f"is another router running there? Choose another with --endpoint"
        ) from _system_error(error)
    return ZenohBus(session, config)


def _system_error(error: zenoh.ZError) -> Exception:
    """The system's error about an address, as Zenoh's text names it; else Zenoh's, as for a port without the right."""
    number = EAGAIN if "Temporary failure in name resolution" in str(error) else 0
    if (match := re.search(r"\(os error (\d+)\)", str(error))) is not None:
        number = int(match[1])
    return error if number in (0, EACCES, EPERM) else OSError(number, first_line(error))


def router_from_file(path: Path) -> ZenohBus:
    """Run the router that a file of Zenoh's own settings describes, as `certify` writes it for a site.

    Args:
        path: the file, JSON5; files that it names are relative to its folder.

    Raises:
        InputError: the file cannot be read or is malformed, or its endpoint cannot be listened at.
    """
    release_large_blocks()
    try:
        config = zenoh.Config.from_file(str(path))
        config.insert_json5(_SHARED_MEMORY, "false")
        for name in _ROUTER_FILES:
            file = json.loads(config.get_json(f"{_TLS}/{name}"))
            if file is not None:
                config.insert_json5(f"{_TLS}/{name}", json.dumps(str(path.parent / file)))
        return ZenohBus(zenoh.open(config), BusConfig())
    except zenoh.ZError as error:
        raise InputError(f"router settings {path}: {first_line(error)}") from _system_error(error)


def _validate(settings: dict[str, Any], endpoint: str) -> zenoh.Config:
    config = zenoh.Config()
    try:
        for path, value in settings.items():
            config.insert_json5(path, json.dumps(value))
    except zenoh.ZError as error:
        raise InputError(
            f"endpoint must be like 'tcp/127.0.0.1:7447', got {endpoint!r}: {first_line(error)}"
        ) from error
    return config


LARGE_BYTES = 4 << 20
"""Four times the largest payload that a node reads: normal operation has no such blocks."""


def release_large_blocks() -> bool:
    """Keep the threshold of the C library's heap at `LARGE_BYTES`; False without such a heap.

    glibc maps blocks above a threshold one by one and unmaps them. When the first of them is freed it raises the
    threshold to the size of that block (up to 32 MB), and takes the next from the heap, where small blocks behind it
    keep its memory from returning (mallopt(3), M_MMAP_THRESHOLD). A monitor that received payloads of 10 MB for a
    quarter of an hour grew by 35 MB from its sixth minute to its last, of which it used 2 MB.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    # M_MMAP_THRESHOLD of malloc.h
    return mallopt is not None and mallopt(-3, LARGE_BYTES) == 1


LOG_EVERY_NS = 1_000_000_000  # a line of the log a second, however many messages are refused
DECISIONS = "error,zenoh::net::routing::interceptor::access_control=trace"
_COLOUR = re.compile(rb"\x1b\[[0-9;]*m")
_DECISION = re.compile(b"routing::interceptor::access_control")
_CACHING = re.compile(rb"(\S+ ThreadId\(\d+\)) .*ACL \(ingress\): caching permissions for `(.*)`")
"""A router decides on every kind of message when a client declares a key, and keeps the decisions for later."""
_VERDICT = re.compile(
    rb"(?P<thread>\S+ ThreadId\(\d+\)) .*access_control: (?P<cached>Using cached result: )?(?P<session>[0-9a-f]+)"
    rb"(?: on .*CertCommonName\((?P<name>[^)]*)\).*)? is (?P<is_refused>un)?authorized to "
    rb"(?P<what>Put|Query|Reply) \(ingress\) on (?P<key>\S+)"
)
"""Decision on a message, or on one that may come, of a session; a decision that was kept lacks the holder's name.
Declarations and deletions are left out: a client that disconnects undeclares its keys, which looks like a Delete."""


class RefusalLog:
    """Turns lines of Zenoh's log, which reports each decision of the access rules, into lines of this software's.

    >>> refusals = RefusalLog()
    >>> line = (b"rx-0 ThreadId(7) access_control: 2f on Interface(lo)+CertCommonName(cstr.plant)+Transport(Tls)+2f "
    ...         b"is unauthorized to Put (ingress) on reactor/cstr/alarm/x")
    >>> [refusals.add(line) for _ in range(3)]
    [True, True, True]
    >>> refusals.report(now_ns=0)
    'refused: Put by cstr.plant on reactor/cstr/alarm/x; 3 refusals since the last line, 3 in all'
    """

    def __init__(self) -> None:
        self._text: str | None = None
        self._since = self._total = 0
        self._names: dict[bytes, bytes] = {}  # of the holders, by session
        self._declared: dict[bytes, tuple[bytes, set[bytes]]] = {}  # key and kinds decided on in advance, by thread
        self._reported_ns: int | None = None

    def add(self, line: bytes) -> bool:
        """Count a line if it is a refusal; returns True for any decision of the rules."""
        caching = _CACHING.search(line)
        if caching is not None:
            self._declared[caching[1]] = caching[2], set()
        verdict = _VERDICT.search(line)
        if verdict is not None and self._is_of_message(verdict) and verdict["is_refused"]:
            name = self._names.get(verdict["session"], verdict["session"])
            parts = (verdict["what"], name, verdict["key"])
            what, holder, key = (ascii(part.decode(errors="replace"))[1:-1][:200] for part in parts)
            self._text = f"refused: {what} by {holder} on {key}"
            self._since, self._total = self._since + 1, self._total + 1
        return _DECISION.search(line) is not None or verdict is not None

    def _is_of_message(self, verdict: re.Match[bytes]) -> bool:
        """True for a decision on a message that came; False for one in advance."""
        if verdict["name"] is not None:
            self._names[verdict["session"]] = verdict["name"]
            if len(self._names) > 10_000:
                del self._names[next(iter(self._names))]
        key, kinds = self._declared.get(verdict["thread"], (b"", set()))
        if not verdict["cached"] and verdict["key"] == key and verdict["what"] not in kinds:
            kinds.add(verdict["what"])
            return False
        return True

    def report(self, now_ns: int) -> str | None:
        """Line to log now; None if nothing was refused since the last one, or that was less than a second ago."""
        if self._text is None or (self._reported_ns is not None and 0 <= now_ns - self._reported_ns < LOG_EVERY_NS):
            return None
        line = f"{self._text}; {self._since} refusals since the last line, {self._total} in all"
        self._text, self._since, self._reported_ns = None, 0, now_ns
        return line


@contextmanager
def log_refusals() -> Iterator[None]:
    """Log refusals of this process's router while the context lasts; to be entered before the router is opened.

    Zenoh's log is on standard output. So a thread reads standard output: refusals go to this software's log, at most a
    line a second, and all else is passed on.
    """
    before = os.dup(1)
    source, sink = os.pipe()
    os.dup2(sink, 1)
    os.close(sink)
    asked = os.environ.get("RUST_LOG")
    if asked == "off":  # the command's own default
        del os.environ["RUST_LOG"]
    zenoh.init_log_from_env_or(DECISIONS)
    if asked is not None:
        os.environ["RUST_LOG"] = asked  # for processes that are started from here on
    ended = threading.Event()
    thread = threading.Thread(target=_read, args=(source, before, ended), name="refusals", daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.dup2(before, 1)  # the last end to write to is closed, unless a process started here has outlived it
        ended.set()
        thread.join()
        os.close(source)
        os.close(before)


def _read(source: int, before: int, ended: threading.Event) -> None:
    refusals, rest = RefusalLog(), b""
    while True:
        is_ready = bool(select([source], [], [], LOG_EVERY_NS / 1e9)[0])
        data = os.read(source, 1 << 16) if is_ready else b""
        *lines, rest = (rest + data).split(b"\n")
        for output in lines:
            if not refusals.add(_COLOUR.sub(b"", output)):
                os.write(before, output + b"\n")
        line = refusals.report(time.monotonic_ns())
        if line is not None:
            log.warning(line)
        if not data and (is_ready or ended.is_set()):
            os.write(before, rest)
            return
