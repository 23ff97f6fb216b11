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

from reactorwatch.errors import InputError, describe_exception
from reactorwatch.limits import Limits, limits, set_limits

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
