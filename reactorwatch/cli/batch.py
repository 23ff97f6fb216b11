"""Many files: what was named becomes a list of them, each is a job, and what came of all is said in one order.

One file that cannot be used is one line, and the rest is finished; the exit code is 2 then, at the end. A single file
is done by this process, as if there were no others to think of.
"""

import csv
import glob
import io
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec
import typer

from reactorwatch.cli.printing import say as print_lines
from reactorwatch.cli.printing import say_text
from reactorwatch.cli.progress import bar, task
from reactorwatch.cli.read_record import stands_for
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
"""A line of a summary: of every file the same names."""


@dataclass(frozen=True)
class Answer:
    """What came of a file.

    Attributes:
        said: to be printed.
        row: of the summary.
        remark: about the file, for people, on standard error; empty: none.
        not_written: why the files that belong to the answer could not be written; empty if they were.
    """

    said: str
    row: Row
    remark: str = ""
    not_written: str = ""


@dataclass(frozen=True)
class Kind(Generic[Job]):
    """A kind of job about a file.

    Attributes:
        doing: what is being done, for people.
        work: does it.
        failed: the row of a file that could not be used, and why.
        summary: rows for people.
    """

    doing: str
    work: Callable[[Job], Answer]
    failed: Callable[[Path, str], Row]
    summary: Callable[[Sequence[Row]], str]


def files_named(names: Sequence[Path]) -> list[Path]:
    """The files that are meant, in the order of the names, and within one in the order of theirs.

    Args:
        names: of files, of folders (see `stands_for`), or patterns such as `runs/*.csv` and `runs/**/*.mcap`. What is
            no pattern is taken as it is, there or not.

    Raises:
        InputError: nothing is like a pattern, or a folder that was named holds nothing to be read.
    """
    found: list[Path] = []
    for name in names:
        if glob.has_magic(str(name)) and not name.exists():
            paths = sorted(map(Path, glob.glob(str(name), recursive=True)))  # noqa: PTH207 (Path has none for absolute patterns)
            like = [file for path in paths for file in (_held_by(path) if path.is_dir() else [path])]
            if not like:
                raise InputError(f"{name}: no file is called like this")
        else:
            like = stands_for(name) if name.is_dir() else [name]
        found += like
    return found


def _held_by(folder: Path) -> list[Path]:
    """What a folder that is like a pattern stands for: nothing, if it is only called so."""
    return stands_for(folder) if list_files(folder, ".csv") or list_files(folder, ".mcap") else []


def say(
    kind: Kind[Job],
    jobs: Sequence[Job],
    files: Sequence[Path],
    out: Path | None,
    *,
    processes: int | None,
    scheduler: str | None,
    as_json: bool,
) -> None:
    """Do the jobs, say what came of each file in their order, and of several what came of all.

    Args:
        kind: of the jobs.
        jobs: one for each file.
        files: that they are about.
        out: folder for the summary, if there are several; None: none is wanted.
        processes: how many; None: one a core.
        scheduler: of a cluster, or None.
        as_json: whether it is said to a machine, so that each line is an object.

    Raises:
        InputError: what a single file cannot be used for; workers that there are not.
        typer.Exit: with 2, some of several files could not be used; which ones has been said.
    """
    if len(jobs) == 1 and scheduler is None:
        with task(f"{kind.doing} {files[0].name}"):
            answer = kind.work(jobs[0])
        say_text(answer.said)
        write_remark(files[0], answer.remark)
        if answer.not_written:
            raise InputError(answer.not_written)
        return
    rows: list[Row] = []
    for file, outcome in zip(files, results(kind.work, jobs, kind.doing, processes, scheduler), strict=True):
        if isinstance(outcome, Failed):
            reason = _without_name(outcome.reason, file)
            print_lines(f"reactorwatch: {file}: {reason}", err=True)
            rows.append(kind.failed(file, reason))
        else:
            say_text(outcome.said)
            write_remark(file, outcome.remark)
            if outcome.not_written:
                print_lines(f"reactorwatch: {file}: {outcome.not_written}", err=True)
            rows.append(outcome.row)
    failed = sum(bool(row["error"]) for row in rows)
    if len(rows) > 1 and not as_json:
        say_text(f"\n{kind.summary(rows)}")
    if len(rows) > 1 and out is not None and failed < len(rows):
        write_summary(out, rows)
    if failed:
        raise typer.Exit(2)


def results(
    work: Callable[[Job], Result], jobs: Sequence[Job], doing: str, processes: int | None, scheduler: str | None
) -> Iterator[Result | Failed]:
    """The outcomes of jobs in their order, under a bar that counts those that are done.

    Args:
        work: a plain function.
        jobs: its arguments.
        doing: what is being done, for people.
        processes: how many; None: one a core.
        scheduler: of a cluster, or None.

    Raises:
        InputError: workers that there are not.
    """
    executor = choose_executor(processes, scheduler)
    with bar(doing, len(jobs)) as advance:

        def counted() -> Iterator[tuple[int, Result | Failed]]:
            advance(0, f"{doing}, none of {len(jobs)} done")
            for count, done in enumerate(executor.map_unordered(work, jobs), start=1):
                advance(count, f"{doing}, {count} of {len(jobs)} done")
                yield done

        yield from in_job_order(counted())


def write_remark(file: Path, remark: str) -> None:
    """Write a remark about a file to standard error, where it disturbs no machine that reads the answer."""
    if remark:
        print_lines(f"reactorwatch: {file}: remark: {remark}", err=True)


def _without_name(reason: str, file: Path) -> str:
    """Why a file cannot be used, without what it is called where the work was done."""
    for name in (str(file.absolute()), str(file), file.name):
        if name and reason.startswith(name) and reason[len(name) :].startswith((": ", ", ")):
            return reason[len(name) + 2 :]
    return reason


def write_summary(folder: Path, rows: Sequence[Row]) -> None:
    """Write `summary.json` and `summary.csv`.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    said = {"files": len(rows), "failed": sum(bool(row["error"]) for row in rows), "results": list(rows)}
    table = io.StringIO()
    writer = csv.DictWriter(table, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    content = {SUMMARY_OBJECT: msgspec.json.format(msgspec.json.encode(said), indent=2) + b"\n"}
    content[SUMMARY_TABLE] = table.getvalue().encode()
    with fill_folder(folder, "--out") as temporary:
        for name, text in content.items():
            with atomic_write(temporary / name) as file:
                file.write_bytes(text)


def as_table(rows: Sequence[dict[str, str]]) -> str:
    """Rows for people, in columns that are as wide as what is in them; an empty column is left out."""
    rows = [{name: printable(cell) for name, cell in row.items()} for row in rows]
    names = [name for name in rows[0] if any(row[name] for row in rows)]
    widths = {name: max(len(name), *(len(row[name]) for row in rows)) for name in names}
    lines = [dict(zip(names, names, strict=True)), *rows]
    return "\n".join("  ".join(line[name].ljust(widths[name]) for name in names).rstrip() for line in lines)
