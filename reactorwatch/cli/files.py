"""Conversion of files: `import`, `export`, `dashboard`."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from reactorwatch.cli.option_groups import TableOptions
from reactorwatch.cli.options import (
    Columns,
    Force,
    Plant,
    ProcessOptions,
    Recording,
    check_input,
    check_output,
    check_recording,
    parse_columns,
)
from reactorwatch.cli.printing import print_lines, print_text
from reactorwatch.errors import InputError

if TYPE_CHECKING:
    from reactorwatch.records.record import Record
    from recorder.columns import RunColumns

Out = Annotated[Path, Option("--out", "-o", help="The file to write.")]


def dashboard(
    *,
    file: Recording,
    out: Out,
    plant: Plant = None,
    chosen: ProcessOptions,
    diagnosis: Annotated[
        Path | None, Option(help="The report of a diagnosis of it (a folder), drawn into a tab.")
    ] = None,
    force: Force = False,
    table: TableOptions,
) -> None:
    """Draw a recording into a Rerun file, without a screen."""
    from reactorwatch.api.files import open_messages
    from reactorwatch.cli.diagnosis import DRAWING
    from reactorwatch.cli.progress import task
    from recorder.columns import read_segments
    from recorder.view.file import write_rrd

    choice = chosen.choose()
    drawn = diagnosis / DRAWING if diagnosis is not None else None
    out = check_output(out, ".rrd", (file, drawn, choice.file), force=force)
    if drawn is not None and not drawn.is_file():
        raise InputError(f"--diagnosis {diagnosis}: holds no {DRAWING}; it must be the folder that diagnose -o wrote")
    with task(f"drawing {file.name}"):
        recording = open_messages(check_recording(file), plant, stated=table.stated, choice=choice)
        run = read_segments(recording.messages, given_zero_ns=recording.zero_ns, process=recording.process)
        write_rrd(_check_samples(run, file), out, diagnosis=drawn)
    print_lines(f"wrote {out}", *([f"note: read as: {recording.read_as}"] if recording.read_as else []))


def _check_samples(runs: "Iterable[RunColumns]", file: Path) -> "Iterator[RunColumns]":
    """Pass segments of a run on, and check that one of them has a usable sample.

    Raises:
        InputError: no segment has one; raised at the end.
    """
    import numpy as np

    is_measured = False
    for run in runs:
        is_measured = is_measured or any(np.isfinite(series.value).any() for series in run.samples.values())
        yield run
    if not is_measured:
        raise InputError(f"{file}: holds no sample that can be used")


def import_csv(
    *,
    files: Annotated[list[Path], Argument(help="A record (.csv or another table), or several in a row.")],
    out: Out,
    plant: Plant = None,
    chosen: ProcessOptions,
    column: Columns = None,
    force: Force = False,
    table: TableOptions,
) -> None:
    """Turn a record (.csv or another table), or several in a row, into a recording (.mcap)."""
    from reactorwatch.cli.progress import task
    from recorder.tools.convert import import_csv as convert

    choice = chosen.choose()
    out = check_output(out, ".mcap", (*files, choice.file), force=force)
    with task(f"importing {files[0].name}"):
        sources = list(map(check_input, files))
        record = convert(sources, out, plant, parse_columns(column), stated=table.stated, choice=choice)
    print_text(_report_text(out, record))


def export_csv(
    *,
    file: Recording,
    out: Out,
    plant: Plant = None,
    chosen: ProcessOptions,
    clock: Annotated[bool, Option("--clock", help="Add a column with the clock time, ISO 8601 in UTC.")] = False,
    force: Force = False,
    table: TableOptions,
) -> None:
    """Turn a recording (.mcap) into a record (.csv, .csv.gz, .xlsx or .parquet), with all its signals."""
    from reactorwatch.cli.progress import task
    from reactorwatch.records.write import WRITTEN_SUFFIXES
    from recorder.tools.convert import export_csv as convert

    choice = chosen.choose()
    out = check_output(out, WRITTEN_SUFFIXES, (file, choice.file), force=force)
    with task(f"exporting {file.name}"):
        record = convert(check_recording(file), out, plant, clock=clock, stated=table.stated, choice=choice)
    print_text(_report_text(out, record))


def _report_text(out: Path, record: "Record") -> str:
    from reactorwatch.records.decode import quote_formula

    remarks, quoted = list(record.remarks), [name for name in record.columns if quote_formula(name) != name]
    if quoted and out.suffix.lower() in (".csv", ".gz"):
        remarks.append(
            f"a spreadsheet would take {quoted[0]!r} for a formula, so a quote stands before it, which is "
            "left out when the file is read here"
        )
    return "\n".join([f"wrote {out}: {record.rows} rows", *(f"note: {remark}" for remark in remarks)])
