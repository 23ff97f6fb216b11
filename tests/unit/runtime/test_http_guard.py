"""Pages answer to requests that name this machine, and close connections that do not finish to ask.

A free port of the loopback address stays reserved for the process that named it.
"""

import errno
import http.server
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest

from reactorwatch.runtime import http_pages as http_guard
from reactorwatch.runtime.config import MetricsConfig
from reactorwatch.runtime.http_pages import (
    LOOPBACK,
    GuardedPort,
    Metrics,
    free_port,
    is_own_host,
    reserve_port,
    serve_metrics,
)
from tests.ports import three_free_ports
from tests.running import WITHIN_S

OWN = (
    "127.0.0.1",
    "127.0.0.1:9101",
    "[::1]:80",
    "192.168.1.20:9101",
    "localhost:3",
    "monitor:9101",
    "RIG.local",
    "a.lan",
)
OTHER = ("evil.example", "evil.example:9101", "127.0.0.1.evil.example", "localhost.evil.example", "", "evil.example.")


def test_the_name_of_this_machine_is_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_guard, "_own_names", lambda: ("rig", "rig.works.example"))
    assert is_own_host("rig.works.example:9101")
    assert not is_own_host("rig.other.example:9101")


@contextmanager
def guarded() -> Iterator[int]:
    """A page that says `secret`, behind a guard; the guard's port."""

    class Page(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", "6")
            self.end_headers()
            self.wfile.write(b"secret")

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer((LOOPBACK, 0), Page) as page:
        thread = threading.Thread(target=page.serve_forever)
        thread.start()
        port = free_port()
        try:
            with GuardedPort(LOOPBACK, port, page.server_address[1]).serving():
                yield port
        finally:
            page.shutdown()
            thread.join()


def answer(port: int, request: bytes) -> bytes:
    """All that comes back until the connection is closed."""
    with socket.create_connection((LOOPBACK, port), timeout=WITHIN_S) as connection:
        connection.sendall(request)
        return b"".join(iter(lambda: connection.recv(1 << 16), b""))


def request_of(host: str) -> bytes:
    return f"GET / HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode()


@pytest.mark.parametrize("host", OWN)
def test_a_guarded_page_is_served_to_this_machine(host: str) -> None:
    with guarded() as port:
        assert answer(port, request_of(host)).endswith(b"secret")


@pytest.mark.parametrize(
    "request_",
    [
        *map(request_of, OTHER),
        b"GET / HTTP/1.0\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n",
        b"GET / HTTP/1.1\r\nhOST:evil.example\r\n\r\n",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        b"\0" * (http_guard.MAX_HEAD + 1),
    ],
)
def test_a_guarded_page_is_not_served_to_a_request_that_names_another_host_or_none(request_: bytes) -> None:
    with guarded() as port:
        came = answer(port, request_)
    assert b"421 Misdirected Request" in came
    assert b"secret" not in came


@contextmanager
def metrics_page() -> Iterator[int]:
    """The page of a node's metrics; its port."""
    pytest.importorskip("prometheus_client", reason="prometheus-client (reactorwatch[metrics]) is not installed")
    port = free_port()
    with serve_metrics(MetricsConfig(port=port), Metrics("plant")):
        yield port


PAGES = {"a page behind the guard": guarded, "the metrics of a node": metrics_page}


@pytest.mark.parametrize("page", PAGES.values(), ids=PAGES)
@pytest.mark.parametrize("part", [b"", b"G", b"GET / HTTP/1.1\r\n", b"GET / HTTP/1.1\r\nHost: localhost\r\n"])
def test_a_request_that_is_not_complete_in_time_is_closed(
    page: Callable[[], AbstractContextManager[int]], part: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http_guard, "REQUEST_TIMEOUT_S", 0.2)
    with page() as port:
        assert b"200 OK" not in answer(port, part)


@pytest.mark.parametrize(("hosts", "is_served"), [(OWN, True), (OTHER, False)])
def test_metrics_are_served_to_requests_that_name_this_machine_alone(
    hosts: tuple[str, ...], *, is_served: bool
) -> None:
    with metrics_page() as port:
        for host in hosts:
            came = answer(port, request_of(host))
            assert (b"200 OK" in came, b"process_cpu_seconds_total" in came) == (is_served, is_served), host


def test_a_kept_port_is_not_given_to_a_socket_that_asks_for_any_and_can_be_had_by_name() -> None:
    port = free_port()
    with socket.socket() as anybody, pytest.raises(OSError, match="in use") as refused:
        anybody.bind((LOOPBACK, port))
    assert refused.value.errno == errno.EADDRINUSE
    with socket.create_server((LOOPBACK, port)) as server:
        assert server.getsockname()[1] == port


def test_a_port_in_use_is_not_kept() -> None:
    with socket.create_server((LOOPBACK, 0)) as server, pytest.raises(OSError, match="in use"):
        reserve_port(server.getsockname()[1])


def test_three_free_ports_are_kept_for_the_first_caller() -> None:
    first, second = three_free_ports(), three_free_ports()
    assert not {*range(first, first + 3)} & {*range(second, second + 3)}
