"""Log of messages that a router's access rules refuse, at most a line a second.

Zenoh reports each decision only in its own log, on standard output. So a thread here reads standard output: refusals go
to this software's log, all else is passed on.
"""

import os
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from select import select

import structlog
import zenoh

log = structlog.get_logger()

LOG_EVERY_NS = 1_000_000_000
DECISIONS = "error,zenoh::net::routing::interceptor::access_control=trace"
_COLOUR = re.compile(rb"\x1b\[[0-9;]*m")
_DECISION = re.compile(b"routing::interceptor::access_control")
_REFUSAL = re.compile(rb"CertCommonName\(([^)]*)\).* is unauthorized to (?!Delete)(\w+) \(ingress\) on (\S+)")
"""Refused message in the log of the router. A Delete is excluded: a client that disconnects undeclares its keys, which
looks like one, and no node publishes any."""
_LONGEST = 200


class RefusalLog:
    """Turns lines of Zenoh's log into lines of this software's.

    >>> refusals = RefusalLog()
    >>> line = (b"access_control: 2f on Interface(lo)+CertCommonName(cstr.plant)+Transport(Tls)+2f "
    ...         b"is unauthorized to Put (ingress) on reactor/cstr/alarm/x")
    >>> [refusals.add(line) for _ in range(3)]
    [True, True, True]
    >>> refusals.report(now_ns=0)
    'refused: Put by cstr.plant on reactor/cstr/alarm/x; 3 refusals since the last line, 3 in all'
    """

    def __init__(self) -> None:
        self._text: str | None = None
        self._since = self._total = 0
        self._reported_ns: int | None = None

    def add(self, line: bytes) -> bool:
        """Count a line if it is a refusal; returns True for any decision of the rules."""
        refusal = _REFUSAL.search(line)
        if refusal is not None:
            who, what, key = (ascii(part.decode(errors="replace"))[1:-1][:_LONGEST] for part in refusal.groups())
            self._text = f"refused: {what} by {who} on {key}"
            self._since, self._total = self._since + 1, self._total + 1
        return _DECISION.search(line) is not None or refusal is not None

    def report(self, now_ns: int) -> str | None:
        """Line to log now; None if nothing was refused since the last one, or that was less than a second ago."""
        if self._text is None or (self._reported_ns is not None and 0 <= now_ns - self._reported_ns < LOG_EVERY_NS):
            return None
        line = f"{self._text}; {self._since} refusals since the last line, {self._total} in all"
        self._text, self._since, self._reported_ns = None, 0, now_ns
        return line


@contextmanager
def log_refusals() -> Iterator[None]:
    """Log refusals of this process's router while the context lasts; to be entered before the router is opened."""
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
