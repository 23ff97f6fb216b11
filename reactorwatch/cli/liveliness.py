"""`alive`: wait for the liveliness token of a node."""

import threading

from reactorwatch.runtime.bus_zenoh import connect
from reactorwatch.runtime.config import BusConfig
from reactorwatch.runtime.event_loop import StopSignal
from reactorwatch.runtime.start import wait_alive


def wait_for_node(config: BusConfig, plant: str, node: str, timeout_s: float) -> bool:
    """Wait for a node; returns whether it is alive in time.

    Args:
        config: connection to the bus.
        plant: name of the plant.
        node: name of the node.
        timeout_s: seconds to wait for router and node together.
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
