"""What a record says: `simulate`, `backtest` and `diagnose`."""

from pathlib import Path
from typing import Annotated

import typer

from reactorwatch.cli.options import (
    Columns,
    Files,
    Force,
    Json,
    Model,
    Plant,
    Processes,
    Scheduler,
    Settings,
    columns,
    existing,
    existing_recording,
    limits,
    output_file,
    tolerances,
)
from reactorwatch.cli.printing import say
from reactorwatch.errors import InputError


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
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Run the plant's equations along a record.

    They start from its first row and run freely, driven by its inputs.
    """
    from reactorwatch.cli.progress import task
    from reactorwatch.cli.read_record import process_model, record, signals_of
    from reactorwatch.cli.simulation import free_run, report
    from reactorwatch.records.csv_file import write_csv

    out = output_file(out, ".csv", (file, model), force=force)
    measured = record(existing_recording(file), plant, columns(column), signals_of(model))
    process = process_model(model, measured)
    with task(f"simulating {file.name}"):
        simulated = free_run(measured, process, fault or [])
        try:
            write_csv(out, simulated)
        except InputError:
            say(report(measured, simulated, process, None, as_json=as_json))
            raise
    say(report(measured, simulated, process, out, as_json=as_json))


def backtest(
    files: Files,
    config: Settings = None,
    plant: Plant = None,
    training: Annotated[
        float | None, typer.Option("--training", help="Minutes to learn from [100].", show_default=False)
    ] = None,
    model: Model = None,
    column: Columns = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for a summary of several files.", show_default=False)
    ] = None,
    jobs: Processes = None,
    scheduler: Scheduler = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Run the monitor over recordings at full speed."""
    from monitor_node.config import MonitorConfig
    from reactorwatch.cli.backtest_jobs import WATCHING, jobs_of
    from reactorwatch.cli.batch import SUMMARY, files_named, say
    from reactorwatch.cli.read_record import DEFAULT_PLANT
    from reactorwatch.records.output import check_output_folder
    from reactorwatch.runtime.config import read_settings, section

    named = files_named(files)
    if out is not None:
        check_output_folder(out, SUMMARY, (*named, config, model), force=force)
    flags = {
        "plant": plant or DEFAULT_PLANT,
        "training_min": training,
        "model": str(existing(model)) if model is not None else None,
    }
    settings = section(MonitorConfig, "monitor", read_settings(config), flags)
    todo = jobs_of(named, settings, plant, columns(column), as_json=as_json, elsewhere=scheduler is not None)
    say(WATCHING, todo, named, out, processes=jobs, scheduler=scheduler, as_json=as_json)


def diagnose(
    files: Files,
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
    jobs: Processes = None,
    scheduler: Scheduler = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Say what the simulation gets wrong, and why."""
    from reactorwatch.cli.batch import files_named, say
    from reactorwatch.cli.diagnosis import Asked
    from reactorwatch.cli.diagnosis_jobs import DIAGNOSING, check_out, jobs_of

    named = files_named(files)
    check_out(named, out, model, force=force)
    asked = Asked(plant, columns(column), model, uncertain, tolerances(tolerance), limits(limit))
    todo = jobs_of(named, out, asked, as_json=as_json, elsewhere=scheduler is not None)
    say(DIAGNOSING, todo, named, out, processes=jobs, scheduler=scheduler, as_json=as_json)
