"""Jobs of a study in processes, and a file of their results from which a study that was stopped continues."""

import argparse
import pickle
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import Progress

from reactorwatch.runtime.jobs import Failed, choose_executor

Job = TypeVar("Job")
Result = TypeVar("Result")


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
        if self._file is not None:
            with self._file.open("ab") as file:
                pickle.dump((key, result), file)


def _read(file: Path) -> Iterator[tuple[str, Any]]:
    """Results of a file up to its end, or up to one that was only half written."""
    if not file.exists():
        return
    with file.open("rb") as stream:
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
