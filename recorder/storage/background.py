"""Work on files that may take a while: one after the other, in a thread of its own, while recording goes on."""

import threading
from collections.abc import Callable
from queue import SimpleQueue

import structlog

from reactorwatch.errors import InputError

log = structlog.get_logger()

Chore = Callable[[], None]


class Chores:
    """A queue of work. What fails is told in the log and is over: it never ends the recording."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[tuple[str, Chore] | None] = SimpleQueue()
        self._thread: threading.Thread | None = None

    def add(self, name: str, chore: Chore) -> None:
        """Do something when all that was added before is done.

        Args:
            name: what it is, for the log.
            chore: the work.
        """
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="chores", daemon=True)
            self._thread.start()
        self._queue.put((name, chore))

    def finish(self) -> None:
        """Wait until all is done; nothing may be added afterwards."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join()

    def _work(self) -> None:
        while (item := self._queue.get()) is not None:
            name, chore = item
            try:
                chore()
            except (InputError, OSError) as error:
                log.warning(f"{name} failed", why=str(error))
