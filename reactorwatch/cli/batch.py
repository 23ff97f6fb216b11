"""Run one job for each of many files, and print the results in the order of the files.

A file that cannot be used costs one line, and an exit code of 2 after the others are done; so does one that holds too
little to be judged, with an exit code of 3 if no other was judged. This process runs the job of a single file itself.
"""

import csv
import glob
import io
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import msgspec
import typer

from reactorwatch.api.files import expand_folder
from reactorwatch.arrays import Array
from reactorwatch.cli.display import bar, format_rows, json_line, print_lines, print_report, task
from reactorwatch.description.read import DEFAULT_CHOICE, ProcessChoice
from reactorwatch.diagnosis.record_checks import find_wrong_unit
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.decode import list_files, quote_formula
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.records.write import atomic_write, fill_folder
from reactorwatch.runtime.jobs import Failed, choose_executor, in_job_order

SUMMARY = SUMMARY_OBJECT, SUMMARY_TABLE = "summary.json", "summary.csv"
Item = TypeVar("Item")
Result = TypeVar("Result")
Options = TypeVar("Options", bound="FileOptions")
Row = dict[str, Any]
"""Row of a summary; the rows of all files have the same names."""


@dataclass(frozen=True, kw_only=True)
class FileOptions:
    """Options of a command, the same for all files."""

    plant: str | None = None  # in recordings; None: the only one
    columns: dict[str, str] = field(default_factory=dict)
    process: ProcessChoice = DEFAULT_CHOICE
    stated: FileFormat = GUESS
    as_json: bool = False


class Job(NamedTuple, Generic[Options]):
    """A file and what is done with it."""

    file: Path  # as named
    at: Path  # for the worker
    asked: Options
    folder: Path | None = None  # for what is written about the file


@dataclass(frozen=True)
class JobResult:
    """Result of a file."""

    text: str
    row: Row
    remark: str = ""  # for standard error
    not_written: str = ""  # why the files of the result are not
    not_watched: str = ""  # why no row could be judged
    extra: Any = None  # what else the command needs


@dataclass(frozen=True)
class JobKind(Generic[Options]):
    """A kind of job.

    The columns are the names of a row's results, between `watched` and `error`. `watched` is false for a file that
    holds too little, and null for one that cannot be read.
    """

    doing: str  # for the progress display
    work: Callable[[Job[Options]], JobResult]
    columns: tuple[str, ...]
    summary: Callable[[Sequence[Row]], str]


def expand_files(names: Sequence[Path]) -> list[Path]:
    """Expand folders and patterns to files, in the order given; files of one are sorted."""
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


def make_jobs(
    files: Sequence[Path], asked: Options, folders: Sequence[Path | None] | None = None, *, elsewhere: bool
) -> list[Job[Options]]:
    """Make a job for each file."""
    folders = [None] * len(files) if folders is None else folders
    if not elsewhere:
        return [Job(file, file, asked, folder) for file, folder in zip(files, folders, strict=True)]
    asked = replace(asked, process=asked.process.absolute())
    return [
        Job(file, file.absolute(), asked, folder and folder.absolute())
        for file, folder in zip(files, folders, strict=True)
    ]


def run_jobs(
    kind: JobKind[Options],
    jobs: Sequence[Job[Options]],
    out: Path | None,
    *,
    processes: int | None,
    scheduler: str | None,
    on_end: Callable[[list[Any]], None] | None = None,
) -> None:
    """Run the jobs and print the result of each file in their order, and a summary of several."""
    file, as_json = jobs[0].file, jobs[0].asked.as_json
    if len(jobs) == 1 and scheduler is None:
        with task(f"{kind.doing} {file.name}"), unfit_lines([file], as_json=as_json):
            result = kind.work(jobs[0])
        print_report(result.text, as_json=as_json)
        write_remark(file, result.remark)
        if result.not_written:
            raise InputError(result.not_written)
        if result.not_watched:
            raise UnfitRecordError(f"{file}: {result.not_watched}")
        if on_end is not None:
            on_end([result.extra])
        return
    rows: list[Row] = []
    extras: list[Any] = []
    with results_in_order(kind.work, jobs, kind.doing, processes, scheduler) as outcomes:
        for (file, *_), outcome in zip(jobs, outcomes, strict=True):
            if isinstance(outcome, Failed):
                reason = _strip_name(outcome.reason, file)
                print_lines(f"reactorwatch: {file}: {reason}", err=True)
                watched = False if outcome.exit_code == UnfitRecordError.exit_code else None
                if as_json and watched is False:
                    print_unfit(file, reason)
                rows.append({"file": str(file), "watched": watched, **dict.fromkeys(kind.columns), "error": reason})
            else:
                print_report(outcome.text, as_json=as_json)
                write_remark(file, outcome.remark)
                if problem := outcome.not_written or outcome.not_watched:
                    print_lines(f"reactorwatch: {file}: {problem}", err=True)
                rows.append(outcome.row)
                if not outcome.not_watched:
                    extras.append(outcome.extra)
    if len(rows) > 1 and not as_json:
        print_report(f"\n{kind.summary(rows)}")
    if len(rows) > 1 and out is not None and _count_failed(rows) < len(rows):
        write_summary(out, rows)
    if on_end is not None and extras:
        on_end(extras)
    if _count_failed(rows):
        raise typer.Exit(InputError.exit_code)
    if not any(row["watched"] for row in rows):
        raise typer.Exit(UnfitRecordError.exit_code)


@contextmanager
def unfit_lines(files: Sequence[Path], *, as_json: bool) -> Generator[None]:
    """Print an object for each file where a record holds too little for all of them, as for a JSON reader."""
    try:
        yield
    except UnfitRecordError as error:
        for file in files if as_json else ():
            print_unfit(file, _strip_name(str(error), file))
        raise


def print_unfit(file: Path, why: str) -> None:
    """Print the object of a file that was not watched, diagnosed or identified."""
    print_report(json_line({"file": str(file), "watched": False, "why": why}), as_json=True)


@contextmanager
def results_in_order(
    work: Callable[[Item], Result], jobs: Sequence[Item], doing: str, processes: int | None, scheduler: str | None
) -> Generator[Iterator[Result | Failed]]:
    """Run jobs, with a bar that counts the finished ones; leaving the context ends the work.

    Left to the garbage collection, the work would be ended while nothing handles the interrupt, which would be raised
    again in the midst of it.
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


def _count_failed(rows: Sequence[Row]) -> int:
    """Number of files with an error, without those that hold too little to be judged."""
    return sum(bool(row["error"]) and row["watched"] is not False for row in rows)


def write_summary(folder: Path, rows: Sequence[Row]) -> None:
    """Write `summary.json` and `summary.csv`."""
    unwatched = sum(row["watched"] is False for row in rows)
    summary = {"files": len(rows), "failed": _count_failed(rows), "not_watched": unwatched, "results": list(rows)}
    table = io.StringIO()
    writer = csv.DictWriter(table, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {name: quote_formula(value) if isinstance(value, str) else value for name, value in row.items()} for row in rows
    )
    content = {SUMMARY_OBJECT: msgspec.json.format(msgspec.json.encode(summary), indent=2) + b"\n"}
    content[SUMMARY_TABLE] = table.getvalue().encode()
    with fill_folder(folder) as temporary:
        for name, text in content.items():
            with atomic_write(temporary / name) as file:
                file.write_bytes(text)


def as_table(rows: Sequence[dict[str, str]]) -> str:
    """Format rows as a table; empty columns are left out."""
    names = [name for name in rows[0] if any(row[name] for row in rows)]
    return format_rows([names, *([row[name] for name in names] for row in rows)])


def unit_remark(model: ProcessModel, columns: Mapping[str, Array], time_min: Array) -> str:
    """Remark on the first unit that is not the model's; empty if there is none."""
    wrong = find_wrong_unit(model, columns, time_min)
    return (
        "" if wrong is None else f"{wrong.text}. The plant's equations cannot be its reference; an identified model can"
    )
