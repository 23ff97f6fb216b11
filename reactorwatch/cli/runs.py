"""Commands that run all nodes: `up` and `demo`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from reactorwatch.cli.options import (
    Diagnose,
    Endpoint,
    Inputs,
    Outputs,
    Plant,
    Process,
    Settings,
    choose_process,
    parse_pace,
)
from reactorwatch.cli.table_options import take_table_options
from reactorwatch.errors import InputError
from reactorwatch.records.file_format import GUESS, FileFormat

if TYPE_CHECKING:
    from reactorwatch.description.choice import ProcessChoice

Site = Annotated[
    Path | None,
    typer.Option(
        help="Folder that `certify` made: run its router, and each node with its certificate [none].",
        show_default=False,
    ),
]


def register_commands(app: typer.Typer) -> None:
    """Register the commands."""
    app.command("up")(take_table_options(up))
    app.command("demo")(demo)


def up(
    config: Settings = None,
    endpoint: Endpoint = None,
    name: Plant = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Folder for the recording, or its file [as in the settings, or runs].",
            show_default=False,
        ),
    ] = None,
    speed: Annotated[
        str | None, typer.Option(help="Plant time over wall time: a number, or 'max' [1].", show_default=False)
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of the input and the noise.", show_default=False)] = None,
    fault: Annotated[list[str] | None, typer.Option(help="A fault, as cause:profile:size@onset. Repeatable.")] = None,
    process: Process = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    record: Annotated[
        Path | None,
        typer.Option(help="Play this record (a recording or a table) in place of a simulated plant."),
    ] = None,
    diagnose: Diagnose = None,
    site: Site = None,
    stated: FileFormat = GUESS,
) -> None:
    """Run router, plant, monitor and recorder until stopped.

    With --record a record is played in place of the simulated plant; the run ends with it.
    """
    from reactorwatch.cli.plant_settings import PlayedRecord
    from reactorwatch.cli.supervise import run_until_stopped

    flags = {
        "name": name,
        "speed": parse_pace(speed, "--speed"),
        "seed": seed,
        "faults": fault or None,
    }
    choice = choose_process(process, inputs, outputs)
    if record is None and (stated != GUESS or choice.outputs):
        raise InputError("options about the form of a table are for the record of --record; name it, or leave them out")
    played = None if record is None else PlayedRecord(record, stated)
    with describe_in_file(choice) as named:
        flags["process"] = named
        raise typer.Exit(run_until_stopped(config, endpoint, out, flags, diagnose, site, played))


@contextmanager
def describe_in_file(choice: "ProcessChoice") -> Iterator[str | None]:
    """Process as settings of nodes name it: columns alone are described in a file, for as long as the nodes run."""
    if not choice.outputs:
        yield choice.process
        return
    import tomli_w

    from reactorwatch.description.toml_file import to_tables

    with TemporaryDirectory(prefix="reactorwatch-") as folder:
        path = Path(folder) / "process.toml"
        path.write_text(tomli_w.dumps(to_tables(choice.load())), encoding="utf-8")
        yield str(path)


def demo(
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the run [runs/demo-<time>].", show_default=False)
    ] = None,
    duration: Annotated[float, typer.Option(help="Minutes of plant time.", min=150)] = 240.0,
    speed: Annotated[str, typer.Option(help="Plant time over wall time.")] = "400",
    fault: Annotated[
        str | None,
        typer.Option(
            help="The fault, as cause:profile:size@onset [of the process; coolant_flow:step:-0.15@150min].",
            show_default=False,
        ),
    ] = None,
    process: Process = None,
    seed: Annotated[int, typer.Option(help="Of the input and the noise.")] = 1,
    site: Site = None,
) -> None:
    """Simulate, watch, record, draw and diagnose a plant with a fault."""
    from reactorwatch.cli.demonstration import Demonstration, run

    speed_value = parse_pace(speed, "--speed")
    assert speed_value is not None
    raise typer.Exit(run(Demonstration(process, duration, speed_value, fault, seed), out, site))
