"""Run one function over many inputs, serially, in processes, or on Dask.

A job is the argument of a plain function; both are pickled, and the function is found by its name. An `Executor` runs
the jobs: in this process (`SerialExecutor`), in processes of this machine (`process_pool`), or on a Dask cluster
(`dask_workers`). Each makes three promises:

- a job that fails has the result `Failed`, and does not affect others;
- a worker that dies costs a retry of its job. A job that kills several workers is a `Failed`, too;
- the results do not depend on the executor or its size: `in_job_order` puts them into the order of the jobs.
"""

import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

from reactorwatch.errors import InputError

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
    """

    reason: str
    is_internal: bool = False


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
            yield number, run_job(work, job)


def run_job(work: Callable[[Job], Result], job: Job) -> Result | Failed:
    """Run a job; an error is its result, and does not end the worker."""
    try:
        return work(job)
    except InputError as error:
        return Failed(one_line(error))
    except Exception as error:  # noqa: BLE001 # no error of a job may stop the others
        frame = traceback.extract_tb(error.__traceback__)[-1]
        return internal_error(error, f" ({Path(frame.filename).name}, line {frame.lineno})")


def internal_error(error: BaseException, where: str = "") -> Failed:
    """Result of a job that ended with an unexpected error."""
    return Failed(f"internal error: {type(error).__name__}: {one_line(error)}{where}", is_internal=True)


def worker_death(times: int) -> Failed:
    """Result of a job at which workers died."""
    return Failed(f"given up: {times} workers died at it; is there too little memory?")


def one_line(error: BaseException) -> str:
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
        from reactorwatch.runtime.parallel.dask_workers import DaskExecutor

        return DaskExecutor(scheduler)
    from reactorwatch.runtime.parallel.process_pool import ProcessExecutor, available_cores

    if processes is None:
        processes = available_cores()
    if processes < 1:
        raise InputError(f"--jobs must be at least 1, got {processes}")
    return SerialExecutor() if processes == 1 else ProcessExecutor(processes)
