"""Many jobs of one kind, here or elsewhere: one seam for whoever has a function and a list of what to do it with.

A job is the argument of a plain function; both are sent to wherever the work is done, so both can be pickled and the
function is found by its name. Who does the work is a `Workers`: this process (`Here`), processes on this machine
(`process_pool`), or a Dask cluster (`dask_workers`). All of them keep three promises:

- a job that fails is an answer, `Failed`, and no other job knows of it;
- a worker that dies costs a retry of the job that it was at. A job that does so again and again is a `Failed`, too;
- the answers do not depend on who does the work, nor on how many: `in_order` puts them into the order of the jobs.
"""

import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

from reactorwatch.errors import InputError

RETRIES = 2
"""Of a job whose worker died: one that does so three times will do so a fourth time."""

Job = TypeVar("Job")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Failed:
    """A job that came to no result.

    Attributes:
        reason: one line.
        ours: whether it is a fault of ours, and not of what was given.
    """

    reason: str
    ours: bool = False


class Workers(Protocol):
    """Who does jobs."""

    def outcomes(self, work: Callable[[Job], Result], jobs: Sequence[Job]) -> Iterator[tuple[int, Result | Failed]]:
        """What came of each job, with its number, as they are done; who stops asking stops the work.

        Args:
            work: of a module that the workers can import.
            jobs: its arguments.
        """


class Here:
    """This process, one job after the other."""

    def outcomes(self, work: Callable[[Job], Result], jobs: Sequence[Job]) -> Iterator[tuple[int, Result | Failed]]:
        """As `Workers` has it."""
        for number, job in enumerate(jobs):
            yield number, attempt(work, job)


def attempt(work: Callable[[Job], Result], job: Job) -> Result | Failed:
    """Do a job; an error is its outcome and not that of the worker."""
    try:
        return work(job)
    except InputError as error:
        return Failed(one_line(error))
    except Exception as error:  # noqa: BLE001 # whatever it is, it must not stop the others
        place = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{Path(place.filename).name}, line {place.lineno}"
        return fault(error, f" ({where})")


def fault(error: BaseException, where: str = "") -> Failed:
    """What is said of a job that ended as none should."""
    return Failed(f"a fault of ours: {type(error).__name__}: {one_line(error)}{where}", ours=True)


def died(times: int) -> Failed:
    """What is said of a job that its workers died of, so many times."""
    return Failed(f"given up: {times} workers died at it; is there too little memory?")


def one_line(error: BaseException) -> str:
    """The text of an error."""
    return " ".join(str(error).split())


def in_order(outcomes: Iterator[tuple[int, Result | Failed]]) -> Iterator[Result | Failed]:
    """The outcomes in the order of the jobs, each as soon as those before it are there."""
    waiting: dict[int, Result | Failed] = {}
    turn = 0
    for number, outcome in outcomes:
        waiting[number] = outcome
        while turn in waiting:
            yield waiting.pop(turn)
            turn += 1


def workers(processes: int | None = None, scheduler: str | None = None) -> Workers:
    """Who does the work.

    Args:
        processes: on this machine; None: one for each of its cores that we may use. One: this process.
        scheduler: of a Dask cluster that does it instead, such as `tcp://127.0.0.1:8786`.

    Raises:
        InputError: both are given, no process is to do it, or there is no such cluster.
    """
    if scheduler is not None:
        if processes is not None:
            raise InputError("--jobs is for this machine, and --scheduler for a cluster; give one of them")
        from reactorwatch.runtime.parallel.dask_workers import DaskWorkers

        return DaskWorkers(scheduler)
    from reactorwatch.runtime.parallel.process_pool import LocalWorkers, cores

    if processes is None:
        processes = cores()
    if processes < 1:
        raise InputError(f"--jobs must be at least 1, got {processes}")
    return Here() if processes == 1 else LocalWorkers(processes)
