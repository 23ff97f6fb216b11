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
_CACHING = re.compile(rb"(\S+ ThreadId\(\d+\)) .*ACL \(ingress\): caching permissions for `(.*)`")
"""A router decides on every kind of message when a client declares a key, and keeps the decisions for later."""
_VERDICT = re.compile(
    rb"(?P<thread>\S+ ThreadId\(\d+\)) .*access_control: (?P<cached>Using cached result: )?(?P<session>[0-9a-f]+)"
    rb"(?: on .*CertCommonName\((?P<name>[^)]*)\).*)? is (?P<is_refused>un)?authorized to "
    rb"(?P<what>Put|Query|Reply) \(ingress\) on (?P<key>\S+)"
)
"""Decision on a message, or on one that may come, of a session; a decision that was kept lacks the holder's name.
Declarations and deletions are left out: a client that disconnects undeclares its keys, which looks like a Delete."""
_LONGEST = 200
MAX_SESSIONS = 10_000
"""Sessions whose names are kept; those of the oldest are dropped first."""


class RefusalLog:
    """Turns lines of Zenoh's log into lines of this software's.

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
            what, who, key = (ascii(part.decode(errors="replace"))[1:-1][:_LONGEST] for part in parts)
            self._text = f"refused: {what} by {who} on {key}"
            self._since, self._total = self._since + 1, self._total + 1
        return _DECISION.search(line) is not None or verdict is not None

    def _is_of_message(self, verdict: re.Match[bytes]) -> bool:
        """True for a decision on a message that came; False for one in advance."""
        if verdict["name"] is not None:
            self._names[verdict["session"]] = verdict["name"]
            if len(self._names) > MAX_SESSIONS:
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
