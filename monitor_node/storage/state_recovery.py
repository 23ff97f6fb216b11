"""Finding out what is known of plants from before, in threads of its own: of a few at a time.

Who watched a plant until now may just be storing what it remembers, and its last words may be on their way; so a plant
is asked for a moment after it has become ours.

To a monitor that is cut off itself all others seem to be gone. It must not take their plants over: so it waits until it
is connected again, and for those who are to be seen again then.
"""

import threading
import time
from collections.abc import Callable
from queue import Empty, SimpleQueue

from monitor_node.ingest.pending import Past
from monitor_node.storage.fleet_states import FleetStates
from reactorwatch.contract import keys
from reactorwatch.errors import InputError
from reactorwatch.runtime.bus import Bus

SETTLE_S = 0.5
RETURN_S = 2.0
"""After we are back: by then those that the same router was gone for are, too."""

LOOK_AGAIN_S = 0.1

AT_A_TIME = 4
"""Plants; one that does not answer, as it is frozen, is waited for for ten seconds."""


class Pasts:
    """Asks for the past of plants.

    Args:
        bus: that they publish on.
        states: what is stored of them; None: nothing is.
        say: gets told, from another thread, what people are to know of a plant: its name and a line.
    """

    def __init__(self, bus: Bus, states: FleetStates | None, say: Callable[[str, str], None]) -> None:
        self._bus, self._states, self._say = bus, states, say
        self._asked: SimpleQueue[tuple[str, float] | None] = SimpleQueue()
        self._found: SimpleQueue[Past] = SimpleQueue()
        self._open = 0
        self._ended = threading.Event()

    def begin(self) -> None:
        """Find those that were asked for, from now on: what is published from now on comes by itself."""
        for _ in range(AT_A_TIME):
            threading.Thread(target=self._find, name="pasts", daemon=True).start()

    @property
    def is_waiting(self) -> bool:
        """Whether there is one that was asked for, and not taken yet."""
        return self._open > 0

    def ask(self, plant: str) -> None:
        """Have the past of a plant found."""
        self._open += 1
        self._asked.put((plant, time.monotonic() + SETTLE_S))

    def found(self) -> list[Past]:
        """Those that were found since the last time."""
        pasts: list[Past] = []
        try:
            while True:
                pasts.append(self._found.get_nowait())
        except Empty:
            self._open -= len(pasts)
            return pasts

    def close(self) -> None:
        """Ask for no more."""
        self._ended.set()
        for _ in range(AT_A_TIME):
            self._asked.put(None)

    def _find(self) -> None:
        while (asked := self._asked.get()) is not None:
            plant, not_before_s = asked
            self._ended.wait(max(0.0, not_before_s - time.monotonic()))
            self._wait_for_the_others()
            if self._ended.is_set():
                return
            state = None
            try:
                state = self._states.read(plant) if self._states is not None else None
            except InputError as error:
                self._say(plant, str(error))
            self._found.put(Past(plant, state, self._bus.query_history(keys.all_keys(plant, keys.SAMPLE))))

    def _wait_for_the_others(self) -> None:
        """If we are cut off ourselves, wait until they are to be seen again."""
        while not (self._bus.has_router or self._ended.is_set()):
            while not (self._bus.has_router or self._ended.wait(LOOK_AGAIN_S)):
                pass
            self._ended.wait(RETURN_S)
