"""Run one function over many inputs, serially, in processes, or on Dask.

A job is the argument of a plain function; both are pickled, and the function is found by its name. An `Executor` runs
the jobs: in this process (`SerialExecutor`), in processes of this machine (`ProcessExecutor`), or on a Dask
cluster (`DaskExecutor`). Each makes three promises:

- a job that fails has the result `Failed`, and does not affect others;
- a worker that dies costs a retry of its job. A job that kills several workers is a `Failed`, too;
- the results do not depend on the executor or its size: `in_job_order` puts them into the order of the jobs.

Each process of the pool runs one job at a time and returns the result over its own pipe.
The standard library's pool breaks as a whole when one of its processes dies, and does not name the job. Here the end of
a pipe identifies both, so the others continue and a new process retries that job.

Processes are spawned and not forked: a fork copies locks that the threads of the linear algebra hold. Each has one
thread of linear algebra, unless the environment sets another number: the matrices are small, and threads would wait for
each other longer than they work.

The workers of a cluster (https://distributed.dask.org, `reactorwatch[cluster]`) see the files under the same paths as
this process, and have the same version of this software, which `DaskExecutor` checks. Dask's scheduler retries the job
of a dead worker by itself, `distributed.scheduler.allowed-failures` times (3 by default). But it also counts the death
for every job that waits at that worker, so a job that it gives up gets a last run when it has the cluster to itself.
"""

import os
import signal
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

from reactorwatch.errors import InputError, describe_exception
from reactorwatch.limits import Limits, limits, set_limits
from reactorwatch.version import version as own_version

RETRIES = 2
"""Retries of a job whose worker died: a job that kills three workers would kill a fourth."""

Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Failed:
    """A job without a result.

    Attributes:
        reason: one line of text.
        is_internal: True for an error of this software, False for unusable input.
        exit_code: see `InputError`.
    """

    reason: str
    is_internal: bool = False
    exit_code: int = InputError.exit_code


class Executor(Protocol):
    """Runs jobs."""

    def map_unordered(
        self, work: Callable[[Job], Result], jobs: Sequence[Job]
    ) -> Generator[tuple[int, Result | Failed]]:
        """Yield each result with the index of its job, as jobs end; closing the iterator stops the work.

        Args:
            work: a function of a module that the workers can import.
            jobs: arguments of the calls.
        """


class SerialExecutor:
    """Runs jobs one after the other in this process."""

    def map_unordered(
        self, work: Callable[[Job], Result], jobs: Sequence[Job]
    ) -> Generator[tuple[int, Result | Failed]]:
        """See `Executor`."""
        for number, job in enumerate(jobs):
            yield number, run_job(work, job, limits())


def run_job(work: Callable[[Job], Result], job: Job, given: Limits) -> Result | Failed:
    """Run a job within the limits of files; an error is its result, and does not end the worker."""
    set_limits(given)
    try:
        return work(job)
    except InputError as error:
        return Failed(one_line(error), exit_code=error.exit_code)
    except Exception as error:  # noqa: BLE001 # no error of a job may stop the others
        frame = traceback.extract_tb(error.__traceback__)[-1]
        return internal_error(error, f" ({Path(frame.filename).name}, line {frame.lineno})")


def internal_error(error: BaseException, where: str = "") -> Failed:
    """Result of a job that ended with an unexpected error."""
    return Failed(f"internal error: {one_line(describe_exception(error))}{where}", is_internal=True)


def worker_death(times: int) -> Failed:
    """Result of a job at which workers died."""
    return Failed(f"given up: {times} workers died at it; is there too little memory?")


def one_line(error: object) -> str:
    """Text of an error on one line."""
    return " ".join(str(error).split())


def in_job_order(outcomes: Iterator[tuple[int, Result | Failed]]) -> Iterator[Result | Failed]:
    """Yield results in the order of their jobs, each as soon as those before it are there."""
    early: dict[int, Result | Failed] = {}
    position = 0
    for index, outcome in outcomes:
        early[index] = outcome
        while position in early:
            yield early.pop(position)
            position += 1


THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables that libraries of linear algebra read when they are loaded."""

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
    worker.process.join(5.0)
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
        return DaskExecutor(scheduler)
    if processes is None:
        processes = available_cores()
    if processes < 1:
        raise InputError(f"--jobs must be at least 1, got {processes}")
    return SerialExecutor() if processes == 1 else ProcessExecutor(processes)


CONNECT_WITHIN_S = 10.0  # a wrong address is reported while its user waits
WORKERS_WITHIN_S = 60.0  # a worker on a busy machine takes half a minute to start


def check_dask(address: str) -> None:
    """Check that Dask is installed and that an address can be that of a scheduler.

    Raises:
        InputError: it is not, or cannot.
    """
    try:
        import distributed  # noqa: F401
    except ImportError as missing:
        raise InputError("--scheduler needs Dask: pip install 'reactorwatch[cluster]'") from missing
    if "://" not in address:
        raise InputError(f"--scheduler must be an address like tcp://127.0.0.1:8786, got {address!r}")


class DaskExecutor:
    """Runs jobs on the workers of a cluster.

    Args:
        address: address of its scheduler, such as `tcp://127.0.0.1:8786`.

    Raises:
        InputError: Dask is not installed, or the address is malformed.
    """

    def __init__(self, address: str) -> None:
        check_dask(address)
        self._address = address

    def map_unordered(
        self, work: Callable[[Job], Result], jobs: Sequence[Job]
    ) -> Generator[tuple[int, Result | Failed]]:
        """See `Executor`.

        Raises:
            InputError: there is no scheduler, it has no workers, or they have another version of this software.
        """
        from distributed import Client
        from distributed.scheduler import KilledWorker

        try:
            connection = Client(self._address, timeout=CONNECT_WITHIN_S, set_as_default=False)
        except (OSError, ValueError) as unreachable:
            text = one_line(unreachable)
            raise InputError(f"--scheduler {self._address}: cannot be reached: {text}") from unreachable
        with connection as client:
            _check_workers(client, self._address)
            indices = {client.submit(run_job, work, job, limits(), pure=False): index for index, job in enumerate(jobs)}
            suspects: list[int] = []
            for future in self._in_completion_order(client, list(indices)):
                index = indices.pop(future)
                if isinstance(future.exception(), KilledWorker):
                    suspects.append(index)
                else:
                    yield index, _outcome(future)
            for index in suspects:
                (alone,) = self._in_completion_order(
                    client, [client.submit(run_job, work, jobs[index], limits(), pure=False)]
                )
                error = alone.exception()
                killed = isinstance(error, KilledWorker)
                yield index, worker_death(error.allowed_failures + 1) if killed else _outcome(alone)

    def _in_completion_order(self, client: Any, futures: list[Any]) -> Iterator[Any]:
        """Yield futures as they complete."""
        from distributed import as_completed

        pending = set(futures)
        while pending:
            try:
                for future in as_completed(list(pending), loop=client.loop, timeout=WORKERS_WITHIN_S):
                    pending.discard(future)
                    yield future
            except TimeoutError:  # also if jobs just take long
                _wait_for_workers(client, self._address)


def _outcome(future: Any) -> Any:
    """Result of a job whose worker lives."""
    error = future.exception()
    if error is not None:  # no error of the job, those are results: it could not be sent or read
        return internal_error(error)
    return future.result()


def _check_workers(client: Any, address: str) -> None:
    versions: dict[str, Any] = {}
    deadline_s = time.monotonic() + WORKERS_WITHIN_S
    while not versions and time.monotonic() < deadline_s:
        _wait_for_workers(client, address)
        replies = client.run(_version_query(), on_error="return")
        # A worker that died meanwhile costs a retry of its jobs; if all did, others are starting.
        versions = {worker: version for worker, version in replies.items() if not isinstance(version, OSError)}
        if not versions:
            time.sleep(0.2)  # the scheduler still lists dead workers
    for worker, version in versions.items():
        if isinstance(version, Exception):
            raise version
        if version is None:
            raise InputError(
                f"--scheduler {address}: worker {worker} has no reactorwatch; install {own_version()} there"
            )
        if version != own_version():
            raise InputError(
                f"--scheduler {address}: worker {worker} has reactorwatch {version}, this is {own_version()}; "
                "install the same"
            )


def _wait_for_workers(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=WORKERS_WITHIN_S)
    except TimeoutError as error:
        raise InputError(
            f"--scheduler {address}: has no workers; start some with: dask worker {address} --nthreads 1"
        ) from error


def inspect_cluster(address: str, security: Any) -> tuple[list[dict[str, float]], float | None]:
    """Resources of each worker of a cluster, and the seconds after which its scheduler removes a silent worker.

    Raises:
        OSError: there is no scheduler, or it refuses the connection.
    """
    from distributed import Client

    def look(dask_scheduler: Any) -> Any:  # pickled by value
        return [worker.resources for worker in dask_scheduler.workers.values()], dask_scheduler.worker_ttl

    with Client(address, security=security, timeout=CONNECT_WITHIN_S, set_as_default=False) as client:
        resources, silent_s = client.run_on_scheduler(look)
        return resources, silent_s


def _version_query() -> Callable[[], str | None]:
    """Function that is pickled by value: a worker that cannot find a function by its name never answers."""

    def installed_version() -> str | None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("reactorwatch")
        except PackageNotFoundError:
            return None

    return installed_version
