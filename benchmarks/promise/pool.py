"""Jobs of `make promise` in processes, and exact intervals of what they count."""

from collections.abc import Callable, Generator, Sequence
from typing import TypeVar

import numpy as np
from scipy.stats import beta, binom, chi2

from reactorwatch.runtime.parallel.jobs import Executor, Failed, in_job_order

Job = TypeVar("Job")
Result = TypeVar("Result")


def run_jobs(executor: Executor, work: Callable[[Job], Result], jobs: Sequence[Job]) -> Generator[Result]:
    """Yield the results of jobs, in their order."""
    for job, outcome in zip(jobs, in_job_order(executor.map_unordered(work, jobs)), strict=True):
        if isinstance(outcome, Failed):
            raise RuntimeError(f"{job}: {outcome.reason}")  # noqa: TRY004 # no wrong type: it failed
        yield outcome


def poisson_interval(count: int) -> tuple[float, float]:
    """Exact 95 % interval of the mean of a Poisson number."""
    low = float(chi2.ppf(0.025, 2 * count)) / 2.0 if count else 0.0
    return low, float(chi2.ppf(0.975, 2 * count + 2)) / 2.0


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Exact 95 % interval of a share (Clopper & Pearson 1934, Biometrika 26)."""
    low = float(beta.ppf(0.025, count, total - count + 1)) if count else 0.0
    return low, float(beta.ppf(0.975, count + 1, total - count)) if count < total else 1.0


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """95 % interval of a median, between two of the sorted values; the whole range of fewer than six.

    >>> median_interval(range(1, 11))
    (2.0, 9.0)
    """
    ordered = np.sort(np.array(values, dtype=np.float64))
    before = int(binom.ppf(0.025, len(ordered), 0.5)) - 1
    return (float(ordered[before]), float(ordered[-1 - before])) if before >= 0 else (ordered[0], ordered[-1])
