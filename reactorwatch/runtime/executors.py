"""Executors of jobs: processes of this machine, or by `dask_workers` those of a cluster.

Each process of the pool runs one job at a time and returns the result over its own pipe.
The standard library's pool breaks as a whole when one of its processes dies, and does not name the job. Here the end of
a pipe identifies both, so the others continue and a new process retries that job.

Processes are spawned and not forked: a fork copies locks that the threads of the linear algebra hold. Each has one
thread of linear algebra, unless the environment sets another number: the matrices are small, and threads would wait for
each other longer than they work.
"""

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, cast

from reactorwatch.errors import InputError
from reactorwatch.limits import Limits, limits
from reactorwatch.runtime.jobs import (
    RETRIES,
    Executor,
    Failed,
    Job,
    Result,
    SerialExecutor,
    internal_error,
    run_job,
    worker_death,
)

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that libraries of linear algebra read when they are loaded."""

END_WITHIN_S = 5.0

_SPAWN = get_context("spawn")


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


@dataclass
class _Worker:
    process: SpawnProcess
    pipe: "Connection[Any, Any]"
    number: int


class ProcessExecutor:
    """Runs jobs in processes, which live while there are jobs.

    Args:
        processes: the largest number of processes.
        retries: retries of a job whose process died.
    """

    def __init__(self, processes: int, retries: int = RETRIES) -> None:
        self._processes = processes
        self._retries = retries
        self._running: dict[Connection[Any, Any], _Worker] = {}
        self._closed = threading.Event()

    def close(self) -> None:
        """End the running processes and start no others, from any thread; the iterator of `map_unordered` then ends.

        A program that ends while a thread of it iterates would otherwise wait for the job: the thread takes the end of
        the process for a death, and starts another one.
        """
        self._closed.set()
        for worker in list(self._running.values()):
            with suppress(ValueError):  # it has just ended by itself
                worker.process.terminate()

    def map_unordered(
        self, work: Callable[[Job], Result], jobs: Sequence[Job]
    ) -> Generator[tuple[int, Result | Failed]]:
        """See `Executor`."""
        queue = deque(range(len(jobs)))
        deaths = [0] * len(jobs)
        running = self._running

        def assign(worker: _Worker) -> None:
            worker.number = queue.popleft()
            with suppress(BrokenPipeError, ConnectionResetError):  # a dead worker is found when its result is read
                worker.pipe.send(jobs[worker.number])

        try:
            while (queue or running) and not self._closed.is_set():
                while queue and len(running) < self._processes:
                    worker = _start(work)
                    running[worker.pipe] = worker
                    assign(worker)
                if self._closed.is_set():  # while one was started
                    return
                for pipe in wait(list(running)):
                    worker = running[cast("Connection[Any, Any]", pipe)]
                    try:
                        outcome = worker.pipe.recv()
                    except (EOFError, OSError):
                        if self._closed.is_set():
                            return
                        del running[worker.pipe]
                        _end(worker)
                        deaths[worker.number] += 1
                        if deaths[worker.number] > self._retries:
                            yield worker.number, worker_death(deaths[worker.number])
                        else:
                            queue.appendleft(worker.number)
                        continue
                    number = worker.number
                    if queue:
                        assign(worker)
                    else:
                        del running[worker.pipe]
                        _end(worker)
                    yield number, outcome
        finally:
            for worker in running.values():
                worker.process.terminate()
            for worker in running.values():
                _end(worker)
            running.clear()


def _start(work: Callable[[Any], Any]) -> _Worker:
    for name in THREADS:
        os.environ.setdefault(name, "1")
    ours, theirs = _SPAWN.Pipe()
    process = _SPAWN.Process(target=_do_jobs, args=(work, limits(), theirs), daemon=True)
    with _without_interrupts():
        process.start()
    theirs.close()  # so that the pipe ends with the process
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
    """Block SIGINT while a process is started; the new process inherits the mask, and this one raises it afterwards.

    The terminal sends Ctrl-C to all processes, and a worker that has only half of its job would print an error; its
    parent ends it instead. The handler is for this process, because the signal may reach another of its threads.
    """
    resource_tracker.ensure_running()  # the first start would do this otherwise, and unblocks the signal
    received: list[int] = []
    in_main = threading.current_thread() is threading.main_thread()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    handler = signal.signal(signal.SIGINT, lambda number, _frame: received.append(number)) if in_main else None
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if in_main:
            signal.signal(signal.SIGINT, handler if handler is not None else signal.SIG_DFL)
        if received:
            signal.raise_signal(signal.SIGINT)


def _do_jobs(work: Callable[[Job], Result], given: Limits, pipe: "Connection[Any, Any]") -> None:
    """Run jobs until the pipe ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        while True:
            outcome = run_job(work, pipe.recv(), given)
            try:
                pipe.send(outcome)
            except OSError:
                raise
            except Exception as error:  # noqa: BLE001 # pickling raises errors of any kind
                pipe.send(internal_error(error))
    except (EOFError, OSError):
        return


def choose_executor(processes: int | None = None, scheduler: str | None = None) -> Executor:
    """Choose an executor.

    Args:
        processes: number of processes on this machine; None: one for each core that this process may use. One: this
            process.
        scheduler: address of a Dask cluster's scheduler, such as `tcp://127.0.0.1:8786`; None: this machine.

    Raises:
        InputError: both are given, there are no processes, or there is no such cluster.
    """
    if scheduler is not None:
        if processes is not None:
            raise InputError("--jobs is for this machine, and --scheduler for a cluster; give one of them")
        from reactorwatch.runtime.dask_workers import DaskExecutor

        return DaskExecutor(scheduler)
    if processes is None:
        processes = available_cores()
    if processes < 1:
        raise InputError(f"--jobs must be at least 1, got {processes}")
    return SerialExecutor() if processes == 1 else ProcessExecutor(processes)
