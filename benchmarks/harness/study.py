"""Studies: jobs in processes with a file of their results, tables as text, exact intervals, and pages between marks."""

import argparse
import json
import pickle
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Console
from rich.progress import Progress
from scipy.stats import binom, binomtest, chi2

from reactorwatch.runtime.jobs import Failed, choose_executor

Job = TypeVar("Job")
Result = TypeVar("Result")

JSON_LINES = ".jsonl"
"""Ending of a file of results as text, for results that are JSON; all others are pickled."""


class Pool:
    """Runs jobs in processes or on a Dask cluster; results in the file are not computed again."""

    def __init__(self, processes: int | None = None, scheduler: str | None = None, results: Path | None = None) -> None:
        self._executor = choose_executor(processes, scheduler)
        self._file = results
        self._stored: dict[str, Any] = dict(_read(results)) if results is not None else {}

    @classmethod
    def of(cls, options: argparse.Namespace) -> "Pool":
        """Make a pool of the options that `add_options` adds."""
        return cls(options.jobs, options.scheduler, options.results)

    def run(
        self,
        title: str,
        work: Callable[[Job], Result],
        jobs: Sequence[Job],
        on_failure: Callable[[Job, Failed], Result] | None = None,
    ) -> list[Result]:
        """Results of all jobs in their order; a job that fails is an error, or what `on_failure` makes of it."""
        settings = work.keywords if isinstance(work, partial) else ""
        keys = [f"{title} {settings}: {job!r}" for job in jobs]
        missing = [index for index, key in enumerate(keys) if key not in self._stored]
        found = {key: self._stored[key] for key in keys if key in self._stored}
        with (
            Progress(console=Console(stderr=True)) as progress,
            closing(self._executor.map_unordered(work, [jobs[index] for index in missing])) as outcomes,
        ):
            for number, outcome in progress.track(outcomes, total=len(missing), description=title):
                index = missing[number]
                if not isinstance(outcome, Failed):
                    self._keep(keys[index], outcome)
                elif on_failure is None:
                    raise RuntimeError(f"{title}: {jobs[index]}: {outcome.reason}")
                else:
                    outcome = on_failure(jobs[index], outcome)
                found[keys[index]] = outcome
        return [found[key] for key in keys]

    def _keep(self, key: str, result: object) -> None:
        if self._file is None:
            return
        with self._file.open("ab") as file:
            if self._file.suffix == JSON_LINES:
                file.write(json.dumps({"key": key, "result": result}).encode() + b"\n")
            else:
                pickle.dump((key, result), file)


def _read(file: Path) -> Iterator[tuple[str, Any]]:
    """Results of a file, without one that was only half written."""
    if not file.exists():
        return
    with file.open("rb") as stream:
        if file.suffix == JSON_LINES:
            for text in stream:
                with suppress(json.JSONDecodeError):
                    item = json.loads(text)
                    yield item["key"], item["result"]
            return
        while True:
            try:
                yield pickle.load(stream)
            except (EOFError, pickle.UnpicklingError):
                return


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of a pool to those of a study."""
    parser.add_argument("--jobs", type=int, help="processes (default: one a core)")
    parser.add_argument("--scheduler", help="address of a Dask cluster that does it instead")
    parser.add_argument("--results", type=Path, help="file that keeps each result; a study that was stopped continues")


def markdown(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table as Markdown, its columns lined up."""
    widths = [max(len(row[index]) for row in [heading, *rows]) for index in range(len(heading))]
    lines = ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in (heading, *rows)]
    return "\n".join([lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]])


def line(*cells: object) -> str:
    """A row of a table of Markdown as it is printed while a study runs."""
    return f"| {' | '.join(map(str, cells))} |"


def head(*cells: str) -> str:
    """Heading of such a table."""
    return f"{line(*cells)}\n{'|---' * len(cells)}|"


def replace_between(page: Path, begin: str, end: str, text: str) -> None:
    """Write a text between two marks of a page."""
    old = page.read_text(encoding="utf-8")
    if begin not in old or end not in old:
        raise ValueError(f"{page.name} must hold the marks {begin} and {end}")
    page.write_text(f"{old.partition(begin)[0]}{begin}\n{text}{end}{old.partition(end)[2]}", encoding="utf-8")


def stamp() -> str:
    """A sentence with today's date and the commit, so that a reader sees how old numbers are."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return f"Measured on {datetime.now(UTC):%Y-%m-%d} with commit {commit.strip()}."


def poisson_interval(count: int) -> tuple[float, float]:
    """Exact 95 % interval of the mean of a Poisson number (Garwood 1936, Biometrika 28)."""
    low = float(chi2.ppf(0.025, 2 * count)) / 2.0 if count else 0.0
    return low, float(chi2.ppf(0.975, 2 * count + 2)) / 2.0


def share_interval(count: int, total: int) -> tuple[float, float]:
    """Exact 95 % interval of a share (Clopper & Pearson 1934, Biometrika 26)."""
    low, high = binomtest(count, total).proportion_ci(method="exact")
    return float(low), float(high)


def percent(count: int, total: int) -> str:
    """A share in percent with its exact 95 % interval."""
    low, high = share_interval(count, total)
    return f"{100 * count / total:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """95 % interval of a median, between two of the sorted values; the whole range of fewer than six.

    >>> median_interval(range(1, 11))
    (2.0, 9.0)
    """
    ordered = np.sort(np.array(values, dtype=np.float64))
    before = int(binom.ppf(0.025, len(ordered), 0.5)) - 1
    return (float(ordered[before]), float(ordered[-1 - before])) if before >= 0 else (ordered[0], ordered[-1])
