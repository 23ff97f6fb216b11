"""Free ports of this machine."""

import socket

from reactorwatch.runtime.http_pages import LOOPBACK, free_port, reserve_port


def three_free_ports() -> int:
    """The first of three in a row."""
    while True:
        first = free_port()
        try:
            for port in (first + 1, first + 2):
                with socket.socket() as probe:
                    probe.bind((LOOPBACK, port))  # else it may be kept for somebody else
                reserve_port(port)
        except (OSError, OverflowError):
            continue
        return first
