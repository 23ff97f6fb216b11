"""Jobs that tests give to workers: functions that another process finds by their name."""

import os
import signal
import threading
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.limits import Limits, limits


def square(x: int) -> int:
    return x * x


def picky(x: int) -> int:
    if x == 1:
        raise InputError("x must not be 1,\ngot 1")
    if x == 2:
        raise ZeroDivisionError("by x - 2")
    return x


def deadly(job: tuple[int, str, int]) -> int:
    """The number of the job; its process is killed as often as said, which is counted in a file."""
    number, folder, times = job
    counted = Path(folder) / f"deaths-{number}"
    before = counted.read_text() if counted.exists() else ""
    if len(before) < times:
        counted.write_text(before + "x")
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def linear_algebra_threads(_job: int) -> str | None:
    return os.environ.get("OPENBLAS_NUM_THREADS")


def unspeakable(x: int) -> object:
    return (lambda: x) if x == 1 else x


def endless(fifo: str) -> None:
    """Write to a pipe with a name, and wait until the process is ended."""
    Path(fifo).write_text("x")
    threading.Event().wait()


def limits_in_force(_job: int) -> Limits:
    return limits()
