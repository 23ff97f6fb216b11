"""What can be done with recordings: `recover`, `info`, `cut` and `merge`."""

from pathlib import Path
from typing import Annotated

import typer

from reactorwatch.cli.options import Json, existing, new_file
from reactorwatch.errors import InputError


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    app.command("recover")(recover)


def recover(
    file: Annotated[Path, typer.Argument(help="A recording that is cut off or damaged.", show_default=False)],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="The file to write [beside it, X-recovered.mcap].", show_default=False),
    ] = None,
    as_json: Json = False,
) -> None:
    """Save what is whole in a damaged recording."""
    import msgspec

    from reactorwatch.cli.progress import task
    from reactorwatch.cli.recording_reports import saved_object, saved_text
    from recorder.part_file import is_held
    from recorder.recover import recover as save

    if is_held(existing(file)):
        raise InputError(f"{file}: is still being written; stop its recorder first")
    out = new_file(out) if out is not None else _beside(file)
    with task(f"recovering {file.name}"):
        saved = save(file, out)
    typer.echo(msgspec.json.encode(saved_object(saved, out)).decode() if as_json else saved_text(saved, file, out))


def _beside(file: Path) -> Path:
    """Where a recovered file goes if nothing is said: it is never written over.

    Raises:
        InputError: there is one already.
    """
    out = file.with_name(f"{file.name.removesuffix('.part').removesuffix('.mcap')}-recovered.mcap")
    if out.exists():
        raise InputError(f"{out}: exists already; name another file with --out")
    return out
