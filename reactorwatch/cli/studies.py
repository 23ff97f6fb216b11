"""Commands on records: `simulate`, `backtest` and `diagnose`."""

from pathlib import Path
from typing import Annotated

import typer

from reactorwatch.cli.display import print_report
from reactorwatch.cli.options import (
    Columns,
    Files,
    Force,
    Json,
    Model,
    Plant,
    Process,
    Processes,
    Scheduler,
    Settings,
    check_input,
    check_output,
    check_recording,
    parse_columns,
    parse_limits,
    parse_tolerances,
    split_names,
)
from reactorwatch.cli.table_options import take_table_options
from reactorwatch.errors import InputError
from reactorwatch.records.file_format import GUESS, FileFormat


def register_commands(app: typer.Typer) -> None:
    """Register the commands."""
    app.command("simulate")(take_table_options(simulate))
    app.command("backtest")(take_table_options(backtest))
    app.command("diagnose")(take_table_options(diagnose))


def simulate(
    file: Annotated[Path, typer.Argument(help="A record (.csv) or recording (.mcap).", show_default=False)],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="The file to write (.csv or another table).", show_default=False)
    ],
    plant: Plant = None,
    fault: Annotated[
        list[str] | None, typer.Option(help="A fault, as cause:profile:size@onset, onset in the file's time.")
    ] = None,
    process: Process = None,
    column: Columns = None,
    force: Force = False,
    as_json: Json = False,
    stated: FileFormat = GUESS,
) -> None:
    """Run the plant's equations along a record.

    They start from its first row and run freely, driven by its inputs.
    """
    from reactorwatch.cli.progress import task
    from reactorwatch.cli.read_record import described_process, process_on_clock, record
    from reactorwatch.cli.simulation import report, simulate_along
    from reactorwatch.description.choice import ProcessChoice
    from reactorwatch.records.write_table import WRITTEN_SUFFIXES, write_table

    choice = ProcessChoice(process)
    out = check_output(out, WRITTEN_SUFFIXES, (file, choice.file), force=force)
    described = described_process(check_recording(file), plant, choice)
    measured = record(file, plant, parse_columns(column), described, stated=stated)
    model = process_on_clock(choice, described, measured.zero_ns).require_model()
    with task(f"simulating {file.name}"):
        simulated = simulate_along(measured, model, fault or [])
        try:
            write_table(out, simulated)
        except InputError:
            print_report(report(measured, simulated, model, None, as_json=as_json), as_json=as_json)
            raise
    print_report(report(measured, simulated, model, out, as_json=as_json), as_json=as_json)


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
    stated: FileFormat = GUESS,
) -> None:
    """Run the monitor over recordings at full speed."""
    from monitor_node.config import MonitorConfig
    from reactorwatch.cli.backtest_jobs import BACKTEST, make_jobs
    from reactorwatch.cli.batch import SUMMARY, expand_files, run_jobs
    from reactorwatch.cli.read_record import DEFAULT_PLANT
    from reactorwatch.records.output import check_output_folder
    from reactorwatch.runtime.config import read_settings, section

    named = expand_files(files)
    if out is not None:
        check_output_folder(out, SUMMARY, (*named, config, model), force=force)
    flags = {
        "plant": plant or DEFAULT_PLANT,
        "training_min": training,
        "model": str(check_input(model)) if model is not None else None,
    }
    settings = section(MonitorConfig, "monitor", read_settings(config), flags)
    columns, elsewhere = parse_columns(column), scheduler is not None
    todo = make_jobs(named, settings, plant, columns, as_json=as_json, elsewhere=elsewhere, stated=stated)
    run_jobs(BACKTEST, todo, named, out, processes=jobs, scheduler=scheduler, as_json=as_json)


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
    process: Process = None,
    without: Annotated[
        list[str] | None,
        typer.Option(
            "--without", help="A cause that is left out (repeatable); nothing takes its place.", show_default=False
        ),
    ] = None,
    plant: Plant = None,
    column: Columns = None,
    jobs: Processes = None,
    scheduler: Scheduler = None,
    force: Force = False,
    as_json: Json = False,
    stated: FileFormat = GUESS,
) -> None:
    """Say what the simulation gets wrong, and why."""
    from reactorwatch.cli.batch import expand_files, run_jobs
    from reactorwatch.cli.diagnosis import DiagnosisOptions
    from reactorwatch.cli.diagnosis_jobs import DIAGNOSIS, check_out, make_jobs
    from reactorwatch.description.choice import ProcessChoice

    named = expand_files(files)
    choice = ProcessChoice(process)
    check_out(named, out, choice.file, force=force)
    asked = DiagnosisOptions(
        plant,
        parse_columns(column),
        choice,
        uncertain,
        parse_tolerances(tolerance),
        parse_limits(limit),
        stated=stated,
        without=split_names(without),
    )
    todo = make_jobs(named, out, asked, as_json=as_json, elsewhere=scheduler is not None)
    run_jobs(DIAGNOSIS, todo, named, out, processes=jobs, scheduler=scheduler, as_json=as_json)
