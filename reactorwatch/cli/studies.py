"""Commands on records: `simulate`, `backtest` and `diagnose`."""

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from reactorwatch.cli.display import print_report
from reactorwatch.cli.options import (
    Columns,
    Files,
    Force,
    Inputs,
    Json,
    Modes,
    Outputs,
    Plant,
    Process,
    Processes,
    Reference,
    Scheduler,
    Settings,
    TrainingMin,
    TrainingRows,
    check_output,
    check_recording,
    choose_process,
    parse_columns,
    parse_limits,
    parse_tolerances,
    split_names,
    training_flags,
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
    settle: Annotated[
        int, typer.Option(help="First rows that set the state it starts from, and are left out of errors.")
    ] = 0,
    column: Columns = None,
    force: Force = False,
    as_json: Json = False,
    stated: FileFormat = GUESS,
) -> None:
    """Run the plant's equations along a record.

    They start from its first row and run freely, driven by its inputs.
    """
    from reactorwatch.api.files import described_process, process_on_clock, record
    from reactorwatch.api.simulation import report, simulate_along
    from reactorwatch.cli.progress import task
    from reactorwatch.description.choice import ProcessChoice
    from reactorwatch.records.write_table import WRITTEN_SUFFIXES, write_table

    choice = ProcessChoice(process)
    out = check_output(out, WRITTEN_SUFFIXES, (file, choice.file), force=force)
    described = described_process(check_recording(file), plant, choice)
    measured = record(file, plant, parse_columns(column), described, stated=stated)
    model = process_on_clock(choice, described, measured.zero_ns).require_model()
    with task(f"simulating {file.name}"):
        simulated = simulate_along(measured, model, fault or [], settle)
        try:
            write_table(out, simulated)
        except InputError:
            print_report(report(measured, simulated, model, None, settle=settle, as_json=as_json), as_json=as_json)
            raise
    print_report(report(measured, simulated, model, out, settle=settle, as_json=as_json), as_json=as_json)


def backtest(
    files: Files,
    config: Settings = None,
    process: Process = None,
    inputs: Inputs = None,
    outputs: Outputs = None,
    modes: Modes = None,
    plant: Plant = None,
    train: Annotated[
        Path | None,
        typer.Option(help="A record to learn from, all of it; FILES are then watched from their first row."),
    ] = None,
    training: TrainingMin = None,
    training_rows: TrainingRows = None,
    reference: Reference = None,
    scheme: Annotated[
        str, typer.Option(help="monitor, or report: watch as the original report does, mean +- 3 sigma of OE(3,3).")
    ] = "monitor",
    column: Columns = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for a summary of several files.", show_default=False)
    ] = None,
    rows: Annotated[
        Path | None,
        typer.Option(help="A file (.csv) for each row of FILES, and whether an alarm is active.", show_default=False),
    ] = None,
    jobs: Processes = None,
    scheduler: Scheduler = None,
    force: Force = False,
    as_json: Json = False,
    stated: FileFormat = GUESS,
) -> None:
    """Run the monitor over recordings at full speed."""
    from monitor_node.config import MonitorConfig
    from reactorwatch.cli.backtest_jobs import BACKTEST, BacktestOptions, make_jobs, train_on, write_rows
    from reactorwatch.cli.batch import SUMMARY, expand_files, run_jobs
    from reactorwatch.cli.progress import task
    from reactorwatch.contract.keys import DEFAULT_PLANT
    from reactorwatch.records.output import check_output_folder
    from reactorwatch.runtime.config import read_settings, section

    named, choice = expand_files(files), choose_process(process, inputs, outputs, modes)
    sources = (*named, config, train, choice.file)
    if out is not None:
        check_output_folder(out, SUMMARY, sources, force=force)
    if rows is not None:
        rows = check_output(rows, ".csv", sources, force=force)
    if train is not None and (training is not None or training_rows is not None):
        raise InputError(f"--train {train}: all of it is the training; leave --training and --training-rows out")
    if train is not None and scheme == "report":
        raise InputError(f"--train {train}: the report's scheme learns from the first rows of each file; leave it out")
    tables = read_settings(config)
    flags: dict[str, Any] = {"plant": plant or DEFAULT_PLANT, "reference": reference}
    if choice.outputs:
        choice.load()  # reports a column of two roles
        flags |= {"inputs": choice.inputs, "outputs": choice.outputs, "modes": choice.modes}
    flags |= training_flags(tables, training, training_rows)
    settings = section(MonitorConfig, "monitor", tables, flags)
    asked = BacktestOptions(
        settings,
        plant,
        parse_columns(column),
        choice,
        stated,
        as_json=as_json,
        log_rows=rows is not None,
        scheme=scheme,
    )
    trained = None
    if train is not None:
        with task(f"learning from {train.name}"):
            trained = train_on(train, asked)
    run_jobs(
        BACKTEST,
        make_jobs(named, asked, trained, elsewhere=scheduler is not None),
        named,
        out,
        processes=jobs,
        scheduler=scheduler,
        as_json=as_json,
        on_end=None if rows is None else partial(write_rows, rows),
    )


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
    """Find where a simulation differs from the record, and name the cause."""
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
