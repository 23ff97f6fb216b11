"""Guard of pages on HTTP: a request must name this machine as its host, and be complete in time.

A web page of another origin may have its own name point to this machine's address (DNS rebinding); the browser then
reads local pages for it, and names that origin in the `Host` header (RFC 9110, section 7.2). A connection whose request
does not come in time is closed, so that half-open ones do not add up.
"""

import contextlib
import re
import socket
import threading
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from ipaddress import ip_address
from socketserver import BaseRequestHandler, ThreadingTCPServer
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer

from reactorwatch.runtime.loopback import LOOPBACK

REQUEST_TIMEOUT_S = 10.0
MAX_HEAD = 1 << 16
"""Bytes of the head of a request; http.client has the same limit for a line."""
BLOCK = 1 << 16
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
    with contextlib.suppress(ValueError):
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
            with contextlib.suppress(OSError):  # the other side has gone
                self.request.sendall(answer.encode())
            return
        with contextlib.suppress(OSError), socket.create_connection((LOOPBACK, self.server.target)) as page:
            page.sendall(head)
            backwards = threading.Thread(target=_pass_on, args=(page, self.request), daemon=True)
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

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """Serve while the context lasts."""
        thread = threading.Thread(target=self.serve_forever, name="pages", daemon=True)
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
        self._overdue = threading.Timer(REQUEST_TIMEOUT_S, _close, (self.request,))
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
    overdue = threading.Timer(REQUEST_TIMEOUT_S, _close, (connection,))
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
    with contextlib.suppress(OSError):  # it has ended
        connection.shutdown(socket.SHUT_RDWR)


def _pass_on(source: socket.socket, sink: socket.socket) -> None:
    """Pass all bytes on until one side ends, and then end the other."""
    with contextlib.suppress(OSError):
        while data := source.recv(BLOCK):
            sink.sendall(data)
    _close(sink)
