"""Files into other files: `import`, `export`, `dashboard`."""

from pathlib import Path
from typing import Annotated

import typer

from reactorwatch.cli.options import Columns, Plant, columns, existing, existing_recording, new_file

Out = Annotated[Path, typer.Option("--out", "-o", help="The file to write.", show_default=False)]


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    app.command("dashboard")(dashboard)
    app.command("import")(import_csv)
    app.command("export")(export_csv)


def dashboard(
    file: Annotated[
        Path, typer.Argument(help="A recording (.mcap), a folder of them, or a record (.csv).", show_default=False)
    ],
    out: Out,
    plant: Plant = None,
) -> None:
    """Draw a recording into a Rerun file, without a screen."""
    from reactorwatch.cli.progress import task
    from reactorwatch.cli.sources import messages
    from recorder.rerun_file import write_rrd
    from recorder.run import read_run

    out = new_file(out)
    with task(f"drawing {file.name}"):
        write_rrd(read_run(messages(existing_recording(file), plant)), out)
    typer.echo(f"wrote {out}")


def import_csv(
    file: Annotated[Path, typer.Argument(help="A record (.csv).", show_default=False)],
    out: Out,
    plant: Plant = None,
    column: Columns = None,
) -> None:
    """Turn a record (.csv) into a recording (.mcap)."""
    from reactorwatch.cli.progress import task
    from recorder.convert import import_csv as convert

    with task(f"importing {file.name}"):
        rows = convert(existing(file), new_file(out), plant or "cstr", columns(column))
    typer.echo(f"wrote {out}: {rows} rows")


def export_csv(
    file: Annotated[Path, typer.Argument(help="A recording (.mcap), or a folder of them.", show_default=False)],
    out: Out,
    plant: Plant = None,
) -> None:
    """Turn a recording (.mcap) into a record (.csv)."""
    from reactorwatch.cli.progress import task
    from recorder.convert import export_csv as convert

    with task(f"exporting {file.name}"):
        rows = convert(existing_recording(file), new_file(out), plant)
    typer.echo(f"wrote {out}: {rows} rows")
