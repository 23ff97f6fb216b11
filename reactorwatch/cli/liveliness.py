"""`alive`: ask the bus whether a node shows its token."""

import threading

from reactorwatch.runtime.bus_zenoh import connect
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.liveliness import wait_alive


def comes_alive(config: BusConfig, plant: str, node: str, timeout_s: float) -> bool:
    """Whether a node is there, or comes within the time.

    Args:
        config: where the router is.
        plant: the node's.
        node: its name.
        timeout_s: how long to wait, for the router too.
    """
    stop = StopSignal()
    timer = threading.Timer(timeout_s, stop.set)
    timer.start()
    try:
        bus = connect(config, "alive", stop)
        if bus is None:
            return False
        try:
            return wait_alive(bus, plant, (node,), stop, "alive")
        finally:
            bus.close()
    finally:
        timer.cancel()
