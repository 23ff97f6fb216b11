"""Addresses on this machine's loopback that nobody listens at, nor soon will.

A port that was only looked at can be another process's before we listen there: the system gives the same ports to all
who ask for any, and to the near ends of connections. But a port that has just had a connection, ended by the side that
listened, is in TIME-WAIT for a minute (RFC 9293, section 3.3.2): it is given to those who name it and do not mind
(SO_REUSEADDR), as routers and viewers do, and to nobody who asks for any.
"""

import socket

LOOPBACK = "127.0.0.1"


def free_port() -> int:
    """A TCP port of the loopback address that is free, and kept for who names it."""
    return keep(0)


def keep(port: int) -> int:
    """Have a port of the loopback address kept for who names it; returns it.

    Args:
        port: 0: any.

    Raises:
        OSError: somebody listens there.
    """
    with socket.create_server((LOOPBACK, port)) as server:
        number: int = server.getsockname()[1]
        with socket.create_connection((LOOPBACK, number)) as near:
            far, _ = server.accept()
            far.close()  # the side that ends it first is the one that waits
            near.recv(1)
    return number


def free_endpoint() -> str:
    """The address of a router there."""
    return f"tcp/{LOOPBACK}:{free_port()}"
