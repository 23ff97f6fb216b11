"""Recover the histories of adopted plants in threads, a few at a time.

A recovery has this order: claim the plant, wait, read its state, query its samples, query the alarms that running
monitors have published. (A monitor without others needs neither claim nor alarms.) A previous owner that still runs
publishes no alarm after the claim (see `claims`), and what it published before is in its cache. It may just be storing
its state, and the last messages of one that was killed may be on their way; therefore the wait.

To a partitioned monitor all others seem to be gone. It must not take their plants over: so it waits until it is
connected again, and until it can see the others.
"""

import threading
import time
from collections.abc import Callable
from queue import SimpleQueue
from typing import NamedTuple

from monitor_node.ingest.pending import PlantHistory
from monitor_node.storage.fleet_states import FleetStates
from reactorwatch.contract import keys
from reactorwatch.errors import InputError
from reactorwatch.runtime.bus import Bus

HANDOVER_S = 0.5
"""Time before the claim, in which this monitor notices that it is partitioned itself, and again after it."""

RETURN_S = 2.0
"""Time after reconnection in which monitors that lost the same router reconnect."""

POLL_S = 0.1

WORKERS = 4
"""Threads. The query of a stalled plant takes ten seconds."""


class _Request(NamedTuple):
    plant: str
    not_before_s: float
    claimed: bool = False


class StateRecovery:
    """Recovers histories of plants.

    Args:
        bus: bus of the plants.
        states: stored states; None: there are none.
        is_contested: called from another thread; returns True if a plant is still to be adopted, and there are other
            monitors.
        report: called from another thread with a plant and a line for the log.
    """

    def __init__(
        self,
        bus: Bus,
        states: FleetStates | None,
        is_contested: Callable[[str], bool],
        report: Callable[[str, str], None],
    ) -> None:
        self._bus, self._states, self._is_contested, self._report = bus, states, is_contested, report
        self._requests: SimpleQueue[_Request | None] = SimpleQueue()
        self._ended = threading.Event()

    def start(self, deliver: Callable[[PlantHistory], None]) -> None:
        """Start the threads, when all subscriptions are complete: later messages arrive by themselves.

        Args:
            deliver: called from another thread with a recovered history. The predecessor's alarms that arrived before
                have to be handled before it.
        """
        for _ in range(WORKERS):
            threading.Thread(target=self._recover, args=(deliver,), name="pasts", daemon=True).start()

    def request(self, plant: str) -> None:
        """Request the history of a plant."""
        self._requests.put(_Request(plant, time.monotonic() + HANDOVER_S))

    def close(self) -> None:
        """Stop the threads."""
        self._ended.set()
        for _ in range(WORKERS):
            self._requests.put(None)

    def _recover(self, deliver: Callable[[PlantHistory], None]) -> None:
        while (request := self._requests.get()) is not None:
            plant = request.plant
            self._ended.wait(max(0.0, request.not_before_s - time.monotonic()))
            self._wait_for_router()
            if self._ended.is_set():
                return
            if not request.claimed and self._claim(plant):
                self._requests.put(_Request(plant, time.monotonic() + HANDOVER_S, claimed=True))
            else:
                deliver(self._history(plant))

    def _claim(self, plant: str) -> bool:
        """Claim a plant, if another monitor may own it; returns True if it did."""
        return self._states is not None and self._is_contested(plant) and self._states.claim(plant)

    def _history(self, plant: str) -> PlantHistory:
        state = None
        try:
            state = self._states.read(plant) if self._states is not None else None
        except InputError as error:
            self._report(plant, str(error))
        samples = self._bus.query_history(keys.all_keys(plant, keys.SAMPLE))
        if not self._is_contested(plant):
            return PlantHistory(plant, state, samples)
        return PlantHistory(plant, state, samples, self._bus.query_history(keys.all_keys(plant, keys.ALARM)))

    def _wait_for_router(self) -> None:
        """Wait until this monitor is connected and sees the others."""
        while self._is_alone():
            while self._is_alone():
                self._ended.wait(POLL_S)
            self._ended.wait(RETURN_S)

    def _is_alone(self) -> bool:
        return not (self._bus.has_router or self._ended.is_set())
