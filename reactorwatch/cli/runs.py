"""Commands that run all nodes: `up` and `demo`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer
from typer import Option

from reactorwatch.cli.option_groups import TableOptions
from reactorwatch.cli.options import Diagnose, PlantOptions, Process, ProcessOptions, Seed, Speed, parse_pace
from reactorwatch.errors import InputError
from reactorwatch.records.file_format import GUESS

if TYPE_CHECKING:
    from reactorwatch.description.choice import ProcessChoice

Site = Annotated[
    Path | None, Option(help="Folder that `certify` made: run its router, and each node with its certificate [none].")
]


def up(
    *,
    target: PlantOptions,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder for the recording, or its file [as in the settings, or runs].")
    ] = None,
    speed: Speed = None,
    seed: Seed = None,
    fault: Annotated[list[str] | None, Option(help="A fault, as cause:profile:size@onset. Repeatable.")] = None,
    chosen: ProcessOptions,
    record: Annotated[
        Path | None, Option(help="Play this record (a recording or a table) in place of a simulated plant.")
    ] = None,
    diagnose: Diagnose = None,
    site: Site = None,
    table: TableOptions,
) -> None:
    """Run router, plant, monitor and recorder until stopped.

    With --record a record is played in place of the simulated plant; the run ends with it.
    """
    from reactorwatch.cli.plant_settings import PlayedRecord
    from reactorwatch.cli.supervise import run_until_stopped

    flags = {
        "name": target.name,
        "speed": parse_pace(speed, "--speed"),
        "seed": seed,
        "faults": fault or None,
    }
    choice = chosen.choose()
    if record is None and (table.stated != GUESS or choice.outputs):
        raise InputError("options about the form of a table are for the record of --record; name it, or leave them out")
    played = None if record is None else PlayedRecord(record, table.stated)
    with describe_in_file(choice) as named:
        flags["process"] = named
        raise typer.Exit(run_until_stopped(target, out, flags, diagnose, site, played))


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
    out: Annotated[Path | None, Option("--out", "-o", help="Folder for the run [runs/demo-<time>].")] = None,
    duration: Annotated[float, Option(help="Minutes of plant time.", min=150)] = 240.0,
    speed: Annotated[str, Option(help="Plant time over wall time.")] = "400",
    fault: Annotated[
        str | None,
        Option(help="The fault, as cause:profile:size@onset [of the process; coolant_flow:step:-0.15@150min]."),
    ] = None,
    process: Process = None,
    seed: Annotated[int, Option(help="Of the input and the noise.")] = 1,
    site: Site = None,
) -> None:
    """Simulate, watch, record, draw and diagnose a plant with a fault."""
    from reactorwatch.cli.demonstration import run

    flags = {"process": process, "duration_min": duration, "speed": parse_pace(speed, "--speed"), "seed": seed}
    raise typer.Exit(run(flags, fault, out, site))
