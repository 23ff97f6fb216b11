"""Run one job for each of many files, and print the results in the order of the files.

A file that cannot be used costs one line, and an exit code of 2 after the others are done. This process runs the job of
a single file itself.
"""

import csv
import glob
import io
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec
import typer

from reactorwatch.api.files import expand_folder
from reactorwatch.cli.display import print_report
from reactorwatch.cli.printing import print_lines
from reactorwatch.cli.progress import bar, task
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.folder import fill_folder
from reactorwatch.records.input_file import list_files
from reactorwatch.runtime.parallel.jobs import Failed, choose_executor, in_job_order
from reactorwatch.terminal import printable

SUMMARY = SUMMARY_OBJECT, SUMMARY_TABLE = "summary.json", "summary.csv"

Job = TypeVar("Job")
Result = TypeVar("Result")
Row = dict[str, Any]
"""Row of a summary; the rows of all files have the same names."""


@dataclass(frozen=True)
class JobResult:
    """Result of a file.

    Attributes:
        text: output.
        row: row of the summary.
        remark: remark on the file for standard error; empty: none.
        not_written: error of writing the result's files; empty: none.
        extra: what else the command needs of the file.
    """

    text: str
    row: Row
    remark: str = ""
    not_written: str = ""
    extra: Any = None


@dataclass(frozen=True)
class JobKind(Generic[Job]):
    """A kind of job.

    Attributes:
        doing: name of the work, for the progress display.
        work: runs a job.
        columns: names of a row's results, between `file` and `error`; null for a file that could not be used.
        summary: formats rows as a table.
    """

    doing: str
    work: Callable[[Job], JobResult]
    columns: tuple[str, ...]
    summary: Callable[[Sequence[Row]], str]


def expand_files(names: Sequence[Path]) -> list[Path]:
    """Expand folders and patterns to files, in the order given; files of one are sorted.

    Args:
        names: names of files, folders (see `expand_folder`), or patterns such as `runs/*.csv` and `runs/**/*.mcap`.
            Names of files are not checked.

    Raises:
        InputError: a pattern has no match, or a folder holds no records and recordings.
    """
    files: list[Path] = []
    for name in names:
        if glob.has_magic(str(name)) and not name.exists():
            paths = sorted(map(Path, glob.glob(str(name), recursive=True)))  # noqa: PTH207 (Path has none for absolute patterns)
            matches = [file for path in paths for file in (_expand_match(path) if path.is_dir() else [path])]
            if not matches:
                raise InputError(f"{name}: no file is called like this")
            files += matches
        else:
            files += expand_folder(name) if name.is_dir() else [name]
    return files


def _expand_match(folder: Path) -> list[Path]:
    """Expand a folder that matches a pattern; one without records and recordings is no file."""
    return expand_folder(folder) if list_files(folder, ".csv") or list_files(folder, ".mcap") else []


def run_jobs(
    kind: JobKind[Job],
    jobs: Sequence[Job],
    files: Sequence[Path],
    out: Path | None,
    *,
    processes: int | None,
    scheduler: str | None,
    as_json: bool,
    on_end: Callable[[list[Any]], None] | None = None,
) -> None:
    """Run the jobs and print the result of each file in their order, and a summary of several.

    Args:
        kind: kind of the jobs.
        jobs: one for each file.
        files: the files.
        out: folder for the summary of several files; None: no folder.
        processes: number of processes; None: one a core.
        scheduler: address of a cluster, or None.
        as_json: print one JSON object a line, without a summary.
        on_end: called with the `extra` of the files that could be used, in their order; None: not called.

    Raises:
        InputError: the single file cannot be used, or there are no such workers.
        typer.Exit: with 2, some of several files could not be used; each has its line.
    """
    if len(jobs) == 1 and scheduler is None:
        with task(f"{kind.doing} {files[0].name}"):
            result = kind.work(jobs[0])
        print_report(result.text, as_json=as_json)
        write_remark(files[0], result.remark)
        if result.not_written:
            raise InputError(result.not_written)
        if on_end is not None:
            on_end([result.extra])
        return
    rows: list[Row] = []
    extras: list[Any] = []
    with results_in_order(kind.work, jobs, kind.doing, processes, scheduler) as outcomes:
        for file, outcome in zip(files, outcomes, strict=True):
            if isinstance(outcome, Failed):
                reason = _strip_name(outcome.reason, file)
                print_lines(f"reactorwatch: {file}: {reason}", err=True)
                rows.append({"file": str(file), **dict.fromkeys(kind.columns), "error": reason})
            else:
                print_report(outcome.text, as_json=as_json)
                write_remark(file, outcome.remark)
                if outcome.not_written:
                    print_lines(f"reactorwatch: {file}: {outcome.not_written}", err=True)
                rows.append(outcome.row)
                extras.append(outcome.extra)
    failed = sum(bool(row["error"]) for row in rows)
    if len(rows) > 1 and not as_json:
        print_report(f"\n{kind.summary(rows)}")
    if len(rows) > 1 and out is not None and failed < len(rows):
        write_summary(out, rows)
    if on_end is not None and extras:
        on_end(extras)
    if failed:
        raise typer.Exit(2)


@contextmanager
def results_in_order(
    work: Callable[[Job], Result], jobs: Sequence[Job], doing: str, processes: int | None, scheduler: str | None
) -> Generator[Iterator[Result | Failed]]:
    """Run jobs, with a bar that counts the finished ones; leaving the context ends the work.

    Left to the garbage collection, the work would be ended while nothing handles the interrupt, which would be raised
    again in the midst of it.

    Args:
        work: a plain function.
        jobs: arguments of the calls.
        doing: name of the work, for the bar.
        processes: number of processes; None: one a core.
        scheduler: address of a cluster, or None.

    Yields:
        The results in the order of the jobs.

    Raises:
        InputError: there are no such workers.
    """
    executor = choose_executor(processes, scheduler)
    with bar(doing, len(jobs)) as advance, closing(executor.map_unordered(work, jobs)) as outcomes:

        def count_results() -> Iterator[tuple[int, Result | Failed]]:
            advance(0, f"{doing}, none of {len(jobs)} done")
            for count, done in enumerate(outcomes, start=1):
                advance(count, f"{doing}, {count} of {len(jobs)} done")
                yield done

        yield in_job_order(count_results())


def write_remark(file: Path, remark: str) -> None:
    """Write a remark on a file to standard error, apart from the output."""
    if remark:
        print_lines(f"reactorwatch: {file}: remark: {remark}", err=True)


def _strip_name(reason: str, file: Path) -> str:
    """Remove the file's name, as the worker knows it, from the start of a reason."""
    for name in (str(file.absolute()), str(file), file.name):
        if name and reason.startswith(name) and reason[len(name) :].startswith((": ", ", ")):
            return reason[len(name) + 2 :]
    return reason


def write_summary(folder: Path, rows: Sequence[Row]) -> None:
    """Write `summary.json` and `summary.csv`.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    summary = {"files": len(rows), "failed": sum(bool(row["error"]) for row in rows), "results": list(rows)}
    table = io.StringIO()
    writer = csv.DictWriter(table, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    content = {SUMMARY_OBJECT: msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n"}
    content[SUMMARY_TABLE] = table.getvalue().encode()
    with fill_folder(folder) as temporary:
        for name, text in content.items():
            with atomic_write(temporary / name) as file:
                file.write_bytes(text)


def as_table(rows: Sequence[dict[str, str]]) -> str:
    """Format rows as a table; empty columns are left out."""
    rows = [{name: printable(cell) for name, cell in row.items()} for row in rows]
    names = [name for name in rows[0] if any(row[name] for row in rows)]
    widths = {name: max(len(name), *(len(row[name]) for row in rows)) for name in names}
    lines = [dict(zip(names, names, strict=True)), *rows]
    return "\n".join("  ".join(line[name].ljust(widths[name]) for name in names).rstrip() for line in lines)
