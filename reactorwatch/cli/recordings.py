"""Commands for recordings: `recover`, `info`, `cut` and `merge`."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from reactorwatch.cli.options import (
    Force,
    Inputs,
    Json,
    Outputs,
    Process,
    check_input,
    check_output,
    check_recording,
    choose_process,
    parse_span_ns,
)
from reactorwatch.cli.printing import print_lines, print_text
from reactorwatch.cli.table_options import take_table_options
from reactorwatch.errors import InputError
from reactorwatch.records.file_format import GUESS, FileFormat


def register_commands(app: typer.Typer) -> None:
    """Register the commands."""
    app.command("recover")(recover)
    app.command("info")(take_table_options(info))
    app.command("cut")(cut)
    app.command("merge")(merge)


def recover(
    file: Annotated[Path, typer.Argument(help="A recording that is cut off or damaged.", show_default=False)],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="The file to write [beside it, X-recovered.mcap].", show_default=False),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Recover the intact messages of a damaged recording."""
    import msgspec

    from reactorwatch.cli.progress import task
    from reactorwatch.cli.recording_reports import saved_object, saved_text
    from recorder.storage.part_file import is_locked
    from recorder.storage.recover import recover as save

    if is_locked(check_input(file)):
        raise InputError(f"{file}: is still being written; stop its recorder first")
    out = check_output(out, ".mcap", (file,), force=force) if out is not None else _beside(file)
    with task(f"recovering {file.name}"):
        saved = save(file, out)
    print_text(msgspec.json.encode(saved_object(saved, out)).decode() if as_json else saved_text(saved, file, out))


def info(
    file: Annotated[
        Path, typer.Argument(help="A recording (.mcap), a folder of them, or a table.", show_default=False)
    ],
    process: Process = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    as_json: Json = False,
    stated: FileFormat = GUESS,
) -> None:
    """Show the contents of a recording, and missing messages; or how a table is read, and what is in it."""
    import msgspec

    from reactorwatch.cli.display import print_report
    from reactorwatch.cli.progress import task
    from reactorwatch.cli.recording_reports import info_object, info_text
    from reactorwatch.cli.table_report import table_object, table_text
    from reactorwatch.description.read import read_signals
    from reactorwatch.records.read_table import read_table
    from reactorwatch.records.source_text import is_table
    from recorder.tools.inspect import inspect

    choice = choose_process(process, inputs, outputs)
    with task(f"reading {file.name}"):
        if is_table(check_recording(file)) and not file.is_dir():
            record = read_table(file, None, stated) if choice.is_default else read_signals(file, choice, None, stated)
            text = msgspec.json.encode(table_object(record, file)).decode() if as_json else table_text(record, file)
        else:
            seen = inspect(file)
            if not choice.is_default:
                seen = replace(seen, processes=dict.fromkeys(seen.overview.runs, choice.load()))
            text = msgspec.json.encode(info_object(seen, file)).decode() if as_json else info_text(seen, file)
    print_report(text, as_json=as_json)


def cut(
    file: Annotated[Path, typer.Argument(help="A recording (.mcap), or a folder of them.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="The file to write (.mcap).", show_default=False)],
    begin: Annotated[
        str | None, typer.Option("--from", help="Since the start, such as 10min [the start].", show_default=False)
    ] = None,
    end: Annotated[
        str | None, typer.Option("--to", help="Since the start, such as 20min [the end].", show_default=False)
    ] = None,
    force: Force = False,
) -> None:
    """Copy a span of plant time out of a recording."""
    from reactorwatch.cli.progress import task
    from recorder.tools.cut import cut as copy
    from recorder.tools.cut import sample_window
    from recorder.tools.inspect import zero_ns_of
    from recorder.tools.mcap_file import ZERO_NS, read_metadata, recordings_in

    from_ns = parse_span_ns(begin, "--from") if begin is not None else -(2**63)
    to_ns = parse_span_ns(end, "--to") if end is not None else 2**63
    if from_ns >= to_ns:
        raise InputError(f"--from must be before --to, got {begin} and {end or 'the end'}")
    out = check_output(out, ".mcap", (file,), force=force)
    with task(f"cutting {file.name}"):
        sources = recordings_in(check_recording(file))
        zero_ns = zero_ns_of(file)
        window = sample_window(sources, zero_ns + from_ns, zero_ns + to_ns)
        about = {**read_metadata(file), "cut": f"from {begin or 'the start'} to {end or 'the end'} of {file.name}"}
        count = copy(sources, out, window, {**about, ZERO_NS: str(zero_ns)})
    print_lines(f"wrote {out}: {count} messages")


def merge(
    files: Annotated[list[Path], typer.Argument(help="Recordings (.mcap), or folders of them.", show_default=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="The file to write (.mcap).", show_default=False)],
    force: Force = False,
) -> None:
    """Merge several recordings into one, in order of receipt."""
    from reactorwatch.cli.progress import task
    from recorder.tools.cut import merge as join
    from recorder.tools.mcap_file import read_metadata, recordings_in

    out = check_output(out, ".mcap", files, force=force)
    with task(f"merging into {out.name}"):
        sources = [source for file in files for source in recordings_in(check_recording(file))]
        for number, source in enumerate(sources):
            if any(source.samefile(other) for other in sources[:number]):
                raise InputError(f"{source}: is named twice, and its messages would be there twice; name it once")
        about = {**read_metadata(files[0]), "merged": ", ".join(source.name for source in sources)}
        count = join(sources, out, about)
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
