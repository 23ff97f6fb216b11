"""Commands for recordings: `recover`, `info` and `cut`."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from reactorwatch.cli.option_groups import TableOptions
from reactorwatch.cli.options import (
    Begin,
    End,
    Force,
    Json,
    ProcessOptions,
    check_input,
    check_output,
    check_recording,
    parse_span_ns,
)
from reactorwatch.cli.printing import json_line, print_lines, print_text
from reactorwatch.errors import InputError


def recover(
    file: Annotated[Path, Argument(help="A recording that is cut off or damaged.")],
    out: Annotated[Path | None, Option("--out", "-o", help="The file to write [beside it, X-recovered.mcap].")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Recover the intact messages of a damaged recording."""
    from reactorwatch.cli.progress import task
    from reactorwatch.cli.recording_reports import saved_object, saved_text
    from recorder.files.copies import recover as save
    from recorder.files.part_file import is_locked

    if is_locked(check_input(file)):
        raise InputError(f"{file}: is still being written; stop its recorder first")
    out = check_output(out, ".mcap", (file,), force=force) if out is not None else _beside(file)
    with task(f"recovering {file.name}"):
        saved = save(file, out)
    print_text(json_line(saved_object(saved, out)) if as_json else saved_text(saved, file, out))


def info(
    *,
    file: Annotated[Path, Argument(help="A recording (.mcap), a folder of them, or a table.")],
    chosen: ProcessOptions,
    as_json: Json = False,
    table: TableOptions,
) -> None:
    """Show the contents of a recording, and missing messages; or how a table is read, and what is in it."""
    from reactorwatch.cli.display import print_report
    from reactorwatch.cli.progress import task
    from reactorwatch.cli.recording_reports import info_object, info_text
    from reactorwatch.cli.table_report import table_object, table_text
    from reactorwatch.description.read import read_signals
    from reactorwatch.records.decode import is_table
    from reactorwatch.records.read import read_table
    from recorder.tools.inspect import inspect

    choice = chosen.choose()
    with task(f"reading {file.name}"):
        if is_table(check_recording(file)) and not file.is_dir():
            record = (
                read_table(file, None, table.stated)
                if choice.is_default
                else read_signals(file, choice, None, table.stated)
            )
            text = json_line(table_object(record, file)) if as_json else table_text(record, file)
        else:
            seen = inspect(file)
            if not choice.is_default:
                seen = replace(seen, processes=dict.fromkeys(seen.overview.runs, choice.load()))
            text = json_line(info_object(seen, file)) if as_json else info_text(seen, file)
    print_report(text, as_json=as_json)


def cut(
    file: Annotated[Path, Argument(help="A recording (.mcap), or a folder of them.")],
    out: Annotated[Path, Option("--out", "-o", help="The file to write (.mcap).")],
    begin: Begin = None,
    end: End = None,
    force: Force = False,
) -> None:
    """Copy a span of plant time out of a recording."""
    from reactorwatch.cli.progress import task
    from recorder.files.copies import cut as copy
    from recorder.files.copies import sample_window
    from recorder.files.metadata import ZERO_NS
    from recorder.files.recording import Recording
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
    """Default path of a recovered file, which is never overwritten.

    Raises:
        InputError: the file exists.
    """
    out = file.with_name(f"{file.name.removesuffix('.part').removesuffix('.mcap')}-recovered.mcap")
    if out.exists():
        raise InputError(f"{out}: exists already; name another file with --out")
    return out
