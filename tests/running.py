"""Run a function in a thread while a test talks to it."""

import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from reactorwatch.runtime.event_loop import StopSignal

WITHIN_S = 60.0

Command = Callable[..., subprocess.CompletedProcess[str]]
"""Runs `reactorwatch` with arguments to its end."""


@contextmanager
def running(work: Callable[[], object], stop: StopSignal) -> Iterator[None]:
    """Something in a thread; it is asked to stop at the end and must then end."""
    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join(WITHIN_S)
    assert not thread.is_alive()
