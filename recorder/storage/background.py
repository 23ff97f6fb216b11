"""Background thread for slow work on files, so that recording continues meanwhile."""

import threading
from collections.abc import Callable
from queue import SimpleQueue

import structlog

from reactorwatch.errors import InputError

log = structlog.get_logger()

Task = Callable[[], None]


class BackgroundTasks:
    """Queue of tasks, run one after the other; a failed task is logged and never ends the recording."""

    def __init__(self) -> None:
        self._queue: SimpleQueue[tuple[str, Task] | None] = SimpleQueue()
        self._thread: threading.Thread | None = None

    def submit(self, name: str, task: Task) -> None:
        """Queue a task; `name` describes it in the log."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="background tasks", daemon=True)
            self._thread.start()
        self._queue.put((name, task))

    def finish(self) -> None:
        """Wait until all tasks are done; none may be submitted afterwards."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join()

    def _work(self) -> None:
        while (item := self._queue.get()) is not None:
            name, task = item
            try:
                task()
            except (InputError, OSError) as error:
                log.warning(f"{name} failed", why=str(error))
