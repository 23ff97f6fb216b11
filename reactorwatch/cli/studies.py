"""What a record says: `simulate`, `backtest` and `diagnose`."""

from pathlib import Path
from typing import Annotated

import typer

from reactorwatch.cli.options import (
    Columns,
    Json,
    Model,
    Plant,
    Settings,
    columns,
    existing,
    existing_recording,
    limits,
    new_file,
    tolerances,
)


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    app.command("simulate")(simulate)
    app.command("backtest")(backtest)
    app.command("diagnose")(diagnose)


def simulate(
    file: Annotated[Path, typer.Argument(help="A record (.csv) or recording (.mcap).", show_default=False)],
    out: Annotated[Path, typer.Option("--out", "-o", help="The file to write (.csv).", show_default=False)],
    plant: Plant = None,
    fault: Annotated[
        list[str] | None, typer.Option(help="A fault, as cause:profile:size@onset, onset in the file's time.")
    ] = None,
    model: Model = None,
    column: Columns = None,
    as_json: Json = False,
) -> None:
    """Run the plant's equations along a record.

    They start from its first row and run freely, driven by its inputs.
    """
    from reactorwatch.cli.progress import task
    from reactorwatch.cli.simulation import free_run, report
    from reactorwatch.cli.sources import process_model, record, signals_of
    from reactorwatch.records.csv_file import write_csv

    measured = record(existing_recording(file), plant, columns(column), signals_of(model))
    process = process_model(model, measured)
    out = new_file(out)
    with task(f"simulating {file.name}"):
        simulated = free_run(measured, process, fault or [])
        write_csv(out, simulated)
    typer.echo(report(measured, simulated, process, out, as_json=as_json))


def backtest(
    file: Annotated[Path, typer.Argument(help="A recording (.mcap) or record (.csv).", show_default=False)],
    config: Settings = None,
    plant: Plant = None,
    training: Annotated[
        float | None, typer.Option("--training", help="Minutes to learn from [100].", show_default=False)
    ] = None,
    model: Model = None,
    column: Columns = None,
    as_json: Json = False,
) -> None:
    """Run the monitor over a recording at full speed."""
    from monitor_node.backtest import run
    from monitor_node.config import MonitorConfig
    from reactorwatch.cli.progress import task
    from reactorwatch.cli.reports import backtest_json, backtest_text
    from reactorwatch.cli.sources import messages, plant_of, zero_of
    from reactorwatch.runtime.config import read_settings, section

    existing_recording(file)
    name = plant_of(file, plant)
    flags = {"plant": name, "training_min": training, "model": str(existing(model)) if model is not None else None}
    settings = section(MonitorConfig, "monitor", read_settings(config), flags)
    with task(f"watching {file.name}"):
        result = run(messages(file, name, columns(column)), settings)
    zero_ns = zero_of(file, result.first_ns)
    typer.echo(backtest_json(result, zero_ns) if as_json else backtest_text(result, zero_ns, file))


def diagnose(
    files: Annotated[list[Path], typer.Argument(help="Records (.csv) or recordings (.mcap).", show_default=False)],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Folder for a report; of several files, a folder each.", show_default=False),
    ] = None,
    tolerance: Annotated[
        str | None,
        typer.Option(
            help="Differences that do not matter in practice, such as C=0.002,T=0.5 [a fiftieth of the range].",
            show_default=False,
        ),
    ] = None,
    uncertain: Annotated[
        str | None,
        typer.Option(
            help="Parameters that are known but to a standard deviation, such as K3=2%,Tf=0.5K [none].",
            show_default=False,
        ),
    ] = None,
    limit: Annotated[
        str | None,
        typer.Option(
            "--limits",
            help="What a proposed experiment keeps to, such as qc=85..115,T=425..455 [a little beyond the record].",
            show_default=False,
        ),
    ] = None,
    model: Model = None,
    plant: Plant = None,
    column: Columns = None,
    as_json: Json = False,
) -> None:
    """Say what the simulation gets wrong, and why."""
    from reactorwatch.cli.diagnosis import cases, results

    accepted, kept = tolerances(tolerance), limits(limit)
    found = cases([existing_recording(file) for file in files], plant, columns(column), model, out, uncertain)
    for said in results(found, accepted, kept, as_json=as_json):
        typer.echo(said)
