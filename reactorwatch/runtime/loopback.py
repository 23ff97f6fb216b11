"""Free ports on the loopback address that no other process takes before they are used.

A free port can be another process's before it is listened at: the system assigns the same ports to all processes that
ask for any port, and to the near ends of connections. But a port whose listener has just closed a connection is in
TIME-WAIT for a minute (RFC 9293, section 3.3.2): it can be bound by number with SO_REUSEADDR, as routers and viewers
do, and is not assigned to a process that asks for any port.
"""

import socket

LOOPBACK = "127.0.0.1"


def free_port() -> int:
    """A free TCP port of the loopback address, reserved as by `reserve_port`."""
    return reserve_port(0)


def reserve_port(port: int) -> int:
    """Put a port of the loopback address into TIME-WAIT, so that it is only given by number; returns it.

    Args:
        port: the port; 0: any.

    Raises:
        OSError: another process listens at the port.
    """
    with socket.create_server((LOOPBACK, port)) as server:
        number: int = server.getsockname()[1]
        with socket.create_connection((LOOPBACK, number)) as near:
            far, _ = server.accept()
            far.close()  # the side that closes first is in TIME-WAIT
            near.recv(1)
    return number


def free_endpoint() -> str:
    """A router's address with a free port."""
    return f"tcp/{LOOPBACK}:{free_port()}"
