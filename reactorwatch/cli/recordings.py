"""Commands for recordings: record, replay, import, export, dashboard, cut, recover."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from reactorwatch.cli.display import json_line, print_lines, print_report, task
from reactorwatch.cli.option_groups import (
    ColumnOptions,
    PlantOptions,
    PlantTableOptions,
    ProcessOptions,
    RecordOptions,
    TableOptions,
    stated_settings,
)
from reactorwatch.cli.options import (
    Begin,
    End,
    Force,
    Json,
    Recording,
    check_input,
    check_output,
    check_recording,
    parse_pace,
    parse_span_ns,
)
from reactorwatch.errors import InputError

if TYPE_CHECKING:
    from reactorwatch.records.record import Record
    from recorder.columns import RunColumns


def record(
    *,
    target: PlantOptions,
    out: Annotated[
        Path | None, Option("--out", "-o", help="File or folder to write to, made if it does not exist [.].")
    ] = None,
) -> None:
    """Record everything on the bus into an MCAP file."""
    from reactorwatch.cli.bus_client import metrics_settings, node_settings
    from reactorwatch.records.write import check_folder_name
    from reactorwatch.runtime.config import section
    from recorder.__main__ import run
    from recorder.config import RecorderConfig

    if out is not None and out.suffix != ".mcap":
        check_folder_name(out, "--out")
    tables, bus = node_settings(target)
    flags = {"plant": target.name, "out": str(out) if out is not None else None}
    run(section(RecorderConfig, "recorder", tables, flags), bus, metrics_settings(tables))


def replay(
    *,
    file: Recording,
    target: PlantOptions,
    rate: Annotated[str | None, Option(help="Times real time: a number, or 'max' [1].")] = None,
    begin: Begin = None,
    end: End = None,
    loop: Annotated[bool | None, Option("--loop", help="Restart at the end.")] = None,
    chosen: ProcessOptions,
    verify: Annotated[
        bool,
        Option(
            "--verify",
            help="Publish nothing; run it through the monitor's core and compare the output with the recorded "
            "messages. Ends with 0 if all are equal, 1 if not.",
        ),
    ] = False,
    up: Annotated[
        bool, Option("--up", help="Bring a router, a monitor and a recorder, as `up --record` does.")
    ] = False,
    as_json: Json = False,
    column: ColumnOptions,
    table: TableOptions,
) -> None:
    """Publish a recording or a record as the plant did, or verify a recording.

    In a terminal the keys space, right, up and down pause and resume it, step it, and change its rate.
    """
    from reactorwatch.cli.bus_client import node_settings

    part = {"--from": begin, "--to": end, "--loop": loop, "--column": column.column}
    if verify:
        from reactorwatch.cli.replay import run

        given = {"--rate": rate, **part, "--input": chosen.inputs, "--output": chosen.outputs, "--up": up}
        _refuse(given, "--verify publishes nothing and takes the whole recording")
        raise typer.Exit(run(check_recording(file), target.config, target.name, chosen.process, as_json=as_json))
    if up:
        from reactorwatch.cli.plant_settings import PlayedRecord
        from reactorwatch.cli.up import run_until_stopped

        _refuse(
            {**part, "--input": chosen.inputs, "--output": chosen.outputs},
            "--up plays the whole file with its own names",
        )
        pace = {"name": target.name, "speed": parse_pace(rate, "--rate"), "process": chosen.process}
        played = PlayedRecord(check_recording(file), table.file_format)
        raise typer.Exit(run_until_stopped(target, None, pace, None, None, played))
    from reactorwatch.records.decode import is_table
    from reactorwatch.records.record import MINUTE_NS
    from reactorwatch.runtime.config import section
    from recorder.config import ReplayConfig
    from recorder.tools.replay import run_replay

    if column.column and not is_table(file):
        raise InputError(f"--column is for the columns of a .csv file or another table, got {file}")
    choice = chosen.choose()
    tables, bus = node_settings(target)
    flags = {
        "file": str(check_recording(file)),
        "plant": target.name,
        "rate": parse_pace(rate, "--rate"),
        "from_min": parse_span_ns(begin, "--from") / MINUTE_NS if begin is not None else None,
        "to_min": parse_span_ns(end, "--to") / MINUTE_NS if end is not None else None,
        "loop": loop,
        "process": choice.process,
        "inputs": choice.inputs or None,
        "outputs": choice.outputs or None,
        "columns": column.columns or None,
        "table": stated_settings(table.file_format),
    }
    run_replay(section(ReplayConfig, "replay", tables, flags), bus)


def _refuse(given: dict[str, Any], why: str) -> None:
    """Refuse options that are given beside one which excludes them."""
    for option, value in given.items():
        if value:
            raise InputError(f"{why}; leave out {option}")


Out = Annotated[Path, Option("--out", "-o", help="The file to write.")]


def dashboard(
    *,
    file: Recording,
    out: Out,
    chosen: ProcessOptions,
    diagnosis: Annotated[
        Path | None, Option(help="The report of a diagnosis of it (a folder), drawn into a tab.")
    ] = None,
    force: Force = False,
    table: PlantTableOptions,
) -> None:
    """Draw a recording into a Rerun file, without a screen."""
    from reactorwatch.api.files import open_messages
    from reactorwatch.cli.diagnose import DRAWING
    from recorder.columns import read_segments
    from recorder.view.file import write_rrd

    choice = chosen.choose()
    drawn = diagnosis / DRAWING if diagnosis is not None else None
    out = check_output(out, ".rrd", (file, drawn, choice.file), force=force)
    if drawn is not None and not drawn.is_file():
        raise InputError(f"--diagnosis {diagnosis}: holds no {DRAWING}; it must be the folder that diagnose -o wrote")
    with task(f"drawing {file.name}"):
        recording = open_messages(check_recording(file), table.plant, stated=table.file_format, choice=choice)
        run = read_segments(recording.messages, given_zero_ns=recording.zero_ns, process=recording.process)
        write_rrd(_check_samples(run, file), out, diagnosis=drawn)
    print_lines(f"wrote {out}", *([f"note: read as: {recording.read_as}"] if recording.read_as else []))


def _check_samples(runs: "Iterable[RunColumns]", file: Path) -> "Iterator[RunColumns]":
    """Pass segments of a run on, and check that one of them has a usable sample."""
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
    chosen: ProcessOptions,
    force: Force = False,
    table: RecordOptions,
) -> None:
    """Turn a record (.csv or another table), or several in a row, into a recording (.mcap)."""
    from recorder.tools.convert import import_csv as convert

    choice = chosen.choose()
    out = check_output(out, ".mcap", (*files, choice.file), force=force)
    with task(f"importing {files[0].name}"):
        sources = list(map(check_input, files))
        record = convert(sources, out, table.plant, table.columns, stated=table.file_format, choice=choice)
    print_report(_report_text(out, record))


def export_csv(
    *,
    file: Recording,
    out: Out,
    chosen: ProcessOptions,
    clock: Annotated[bool, Option("--clock", help="Add a column with the clock time, ISO 8601 in UTC.")] = False,
    force: Force = False,
    table: PlantTableOptions,
) -> None:
    """Turn a recording (.mcap) into a record (.csv, .csv.gz, .xlsx or .parquet), with all its signals."""
    from reactorwatch.records.write import WRITTEN_SUFFIXES
    from recorder.tools.convert import export_csv as convert

    choice = chosen.choose()
    out = check_output(out, WRITTEN_SUFFIXES, (file, choice.file), force=force)
    with task(f"exporting {file.name}"):
        record = convert(check_recording(file), out, table.plant, clock=clock, stated=table.file_format, choice=choice)
    print_report(_report_text(out, record))


def _report_text(out: Path, record: "Record") -> str:
    from reactorwatch.records.decode import quote_formula

    remarks, quoted = list(record.remarks), [name for name in record.columns if quote_formula(name) != name]
    if quoted and out.suffix.lower() in (".csv", ".gz"):
        remarks.append(
            f"a spreadsheet would take {quoted[0]!r} for a formula, so a quote stands before it, which is "
            "left out when the file is read here"
        )
    return "\n".join([f"wrote {out}: {record.rows} rows", *(f"note: {remark}" for remark in remarks)])


def recover(
    file: Annotated[Path, Argument(help="A recording that is cut off or damaged.")],
    out: Annotated[Path | None, Option("--out", "-o", help="The file to write [beside it, X-recovered.mcap].")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Recover the intact messages of a damaged recording."""
    from reactorwatch.cli.info import saved_object, saved_text
    from recorder.files.copies import recover as save
    from recorder.files.writer import is_locked

    if is_locked(check_input(file)):
        raise InputError(f"{file}: is still being written; stop its recorder first")
    out = check_output(out, ".mcap", (file,), force=force) if out is not None else _beside(file)
    with task(f"recovering {file.name}"):
        saved = save(file, out)
    text = json_line(saved_object(saved, out)) if as_json else saved_text(saved, file, out)
    print_report(text, as_json=as_json)


def cut(
    file: Annotated[Path, Argument(help="A recording (.mcap), or a folder of them.")],
    out: Annotated[Path, Option("--out", "-o", help="The file to write (.mcap).")],
    begin: Begin = None,
    end: End = None,
    force: Force = False,
) -> None:
    """Copy a span of plant time out of a recording."""
    from recorder.files.copies import cut as copy
    from recorder.files.copies import sample_window
    from recorder.files.recording import ZERO_NS, Recording
    from recorder.tools.inspect import zero_ns_of

    from_ns = parse_span_ns(begin, "--from") if begin is not None else -(2**63)
    to_ns = parse_span_ns(end, "--to") if end is not None else 2**63
    if from_ns >= to_ns:
        raise InputError(f"--from must be before --to, got {begin} and {end or 'the end'}")
    out = check_output(out, ".mcap", (file,), force=force)
    with task(f"cutting {file.name}"):
        recording = Recording(check_recording(file))
        sources, zero_ns = recording.files, zero_ns_of(recording)
        window = sample_window(sources, zero_ns + from_ns, zero_ns + to_ns)
        about = {**recording.metadata, "cut": f"from {begin or 'the start'} to {end or 'the end'} of {file.name}"}
        count = copy(sources, out, window, {**about, ZERO_NS: str(zero_ns)})
    print_lines(f"wrote {out}: {count} messages")


def _beside(file: Path) -> Path:
    """Default path of a recovered file, which is never overwritten."""
    out = file.with_name(f"{file.name.removesuffix('.part').removesuffix('.mcap')}-recovered.mcap")
    if out.exists():
        raise InputError(f"{out}: exists already; name another file with --out")
    return out
