"""Addresses on this machine's loopback that nobody listens at."""

import socket


def free_port() -> int:
    """A TCP port of the loopback address that is free now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def free_endpoint() -> str:
    """The address of a router there."""
    return f"tcp/127.0.0.1:{free_port()}"
