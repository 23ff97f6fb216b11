"""Wait for other nodes: a node shows a liveliness token once it is subscribed."""

import threading
from collections.abc import Collection

import structlog

from reactorwatch.contract import keys
from reactorwatch.runtime.bus import Bus
from reactorwatch.runtime.event_loop import StopSignal

log = structlog.get_logger()

LOG_INTERVAL_S = 30.0


def wait_alive(bus: Bus, plant: str, nodes: Collection[str], stop: StopSignal, waiting: str) -> bool:
    """Wait until nodes of a plant are alive, all at the same time.

    Args:
        bus: an open bus.
        plant: name of the plant.
        nodes: names of the nodes.
        stop: ends the wait.
        waiting: name of the waiting node, for a line in the log now and every half minute.

    Returns:
        True once they are all alive; False if a stop was requested first.
    """
    changed = threading.Event()
    alive: set[str] = set()

    def on_token(key: str, is_alive: bool) -> None:
        topic = keys.parse(key)
        if topic is not None:
            (alive.add if is_alive else alive.discard)(topic.name)
            changed.set()

    stop.call_on_set(changed.set)
    if nodes:
        bus.subscribe_liveliness(keys.all_keys(plant, keys.ALIVE), on_token)
    while True:
        changed.clear()  # before the check: a later change wakes the wait below
        missing = [node for node in nodes if node not in alive]
        if stop.is_set or not missing:
            return not stop.is_set
        log.info("waiting", node=waiting, for_=", ".join(missing))
        changed.wait(LOG_INTERVAL_S)
