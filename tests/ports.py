"""Ports of this machine that nobody listens at."""

import socket

LOOPBACK = "127.0.0.1"


def three_free_ports() -> int:
    """The first of three in a row."""
    while True:
        with socket.socket() as first, socket.socket() as second, socket.socket() as third:
            first.bind((LOOPBACK, 0))
            number = int(first.getsockname()[1])
            try:
                second.bind((LOOPBACK, number + 1))
                third.bind((LOOPBACK, number + 2))
            except (OSError, OverflowError):
                continue
            return number
