"""Commands that run all nodes: `up` and `demo`."""

from pathlib import Path
from typing import Annotated

import typer

from reactorwatch.cli.options import Diagnose, Endpoint, Plant, Settings, parse_pace

Site = Annotated[
    Path | None,
    typer.Option(
        help="Folder that `certify` made: run its router, and each node with its certificate [none].",
        show_default=False,
    ),
]


def register_commands(app: typer.Typer) -> None:
    """Register the commands."""
    app.command("up")(up)
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
    diagnose: Diagnose = None,
    site: Site = None,
) -> None:
    """Run router, plant, monitor and recorder until stopped."""
    from reactorwatch.cli.supervise import run_until_stopped

    flags = {"name": name, "speed": parse_pace(speed, "--speed"), "seed": seed, "faults": fault or None}
    raise typer.Exit(run_until_stopped(config, endpoint, out, flags, diagnose, site))


def demo(
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the run [runs/demo-<time>].", show_default=False)
    ] = None,
    duration: Annotated[float, typer.Option(help="Minutes of plant time.", min=150)] = 240.0,
    speed: Annotated[str, typer.Option(help="Plant time over wall time.")] = "400",
    fault: Annotated[
        str, typer.Option(help="The fault, as cause:profile:size@onset.")
    ] = "coolant_flow:step:-0.15@150min",
    seed: Annotated[int, typer.Option(help="Of the input and the noise.")] = 1,
    site: Site = None,
) -> None:
    """Run it all with a fault in it, draw it, say what happened."""
    from reactorwatch.cli.demonstration import run

    speed_value = parse_pace(speed, "--speed")
    assert speed_value is not None
    raise typer.Exit(run(out, duration, speed_value, fault, seed, site))
