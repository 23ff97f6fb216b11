"""A free port of the loopback address stays reserved for the process that named it."""

import errno
import socket

import pytest

from reactorwatch.runtime.http_pages import LOOPBACK, free_port, reserve_port
from tests.ports import three_free_ports


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
