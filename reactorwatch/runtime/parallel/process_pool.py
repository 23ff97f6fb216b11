"""Jobs in processes on this machine: each does one job at a time and tells its answer over a pipe of its own.

The pool of the standard library breaks as a whole when one of its processes dies, and cannot say which job that
was at. Here a pipe that ends says both, so the others go on and that one job is tried again by a new process.

Processes are spawned and not forked: a fork copies locks that the threads of the linear algebra hold. Each has one
thread of linear algebra, unless the environment says otherwise: the matrices are small, and threads would wait for each
other longer than they work.
"""

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, TypeVar, cast

from reactorwatch.runtime.parallel.jobs import RETRIES, Failed, attempt, died, fault

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""What the libraries of linear algebra read as they are loaded."""

END_WITHIN_S = 5.0

Job = TypeVar("Job")
Result = TypeVar("Result")

_SPAWN = get_context("spawn")


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


@dataclass
class _Worker:
    process: SpawnProcess
    pipe: "Connection[Any, Any]"
    number: int


class LocalWorkers:
    """Processes that are there while there are jobs.

    Args:
        processes: how many at most.
        retries: of a job whose process died.
    """

    def __init__(self, processes: int, retries: int = RETRIES) -> None:
        self._processes = processes
        self._retries = retries

    def outcomes(self, work: Callable[[Job], Result], jobs: Sequence[Job]) -> Iterator[tuple[int, Result | Failed]]:
        """As `Workers` has it."""
        left = deque(range(len(jobs)))
        deaths = [0] * len(jobs)
        running: dict[Connection[Any, Any], _Worker] = {}

        def give(worker: _Worker) -> None:
            worker.number = left.popleft()
            worker.pipe.send(jobs[worker.number])

        try:
            while left or running:
                while left and len(running) < self._processes:
                    worker = _started(work)
                    running[worker.pipe] = worker
                    _tell(worker, give)
                for pipe in wait(list(running)):
                    worker = running[cast("Connection[Any, Any]", pipe)]
                    try:
                        outcome = worker.pipe.recv()
                    except (EOFError, OSError):
                        del running[worker.pipe]
                        _end(worker)
                        deaths[worker.number] += 1
                        if deaths[worker.number] > self._retries:
                            yield worker.number, died(deaths[worker.number])
                        else:
                            left.appendleft(worker.number)
                        continue
                    number = worker.number
                    if left:
                        _tell(worker, give)
                    else:
                        del running[worker.pipe]
                        _end(worker)
                    yield number, outcome
        finally:
            for worker in running.values():
                worker.process.terminate()
            for worker in running.values():
                _end(worker)


def _tell(worker: _Worker, give: Callable[[_Worker], None]) -> None:
    """Give a worker its next job; that it is dead shows when its answer is read."""
    try:
        give(worker)
    except (BrokenPipeError, ConnectionResetError):
        return


def _started(work: Callable[[Any], Any]) -> _Worker:
    for name in THREADS:
        os.environ.setdefault(name, "1")
    ours, theirs = _SPAWN.Pipe()
    process = _SPAWN.Process(target=_do_jobs, args=(work, theirs), daemon=True)
    with _without_interrupts():
        process.start()
    theirs.close()  # so that our end sees the pipe end with the process
    return _Worker(process, ours, -1)


def _end(worker: _Worker) -> None:
    worker.pipe.close()
    worker.process.join(END_WITHIN_S)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()
    worker.process.close()


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """What is started meanwhile does not hear Ctrl-C, which the terminal sends to all: we end it.

    We hear it afterwards: a process that is half told what to do would complain. The mask is what the new process
    inherits, and the handler is for us, because another of our threads may be the one that is told.
    """
    resource_tracker.ensure_running()  # by the first process otherwise, and it lets the signal through again
    heard: list[int] = []
    in_main = threading.current_thread() is threading.main_thread()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    handler = signal.signal(signal.SIGINT, lambda number, _frame: heard.append(number)) if in_main else None
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if in_main:
            signal.signal(signal.SIGINT, handler if handler is not None else signal.SIG_DFL)
        if heard:
            signal.raise_signal(signal.SIGINT)


def _do_jobs(work: Callable[[Job], Result], pipe: "Connection[Any, Any]") -> None:
    """What a worker does until nobody is there to tell."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        while True:
            outcome = attempt(work, pipe.recv())
            try:
                pipe.send(outcome)
            except OSError:
                raise
            except Exception as error:  # noqa: BLE001 # what cannot be pickled, of whatever kind
                pipe.send(fault(error))
    except (EOFError, OSError):
        return
