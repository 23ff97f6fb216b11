"""Commands on records: `simulate`, `backtest` and `diagnose`."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from reactorwatch.cli.display import print_report
from reactorwatch.cli.option_groups import TableOptions
from reactorwatch.cli.options import (
    Columns,
    Files,
    Force,
    Jobs,
    Json,
    Plant,
    Process,
    ProcessOptions,
    RecordFile,
    Reference,
    Scheduler,
    Settings,
    TrainingOptions,
    check_output,
    check_recording,
    parse_columns,
    parse_limits,
    parse_tolerances,
    split_names,
)
from reactorwatch.errors import InputError


def simulate(
    *,
    file: RecordFile,
    out: Annotated[Path, Option("--out", "-o", help="The file to write (.csv or another table).")],
    plant: Plant = None,
    fault: Annotated[
        list[str] | None, Option(help="A fault, as cause:profile:size@onset, onset in the file's time.")
    ] = None,
    process: Process = None,
    settle: Annotated[
        int, Option(help="First rows that set the state it starts from, and are left out of errors.")
    ] = 0,
    column: Columns = None,
    force: Force = False,
    as_json: Json = False,
    table: TableOptions,
) -> None:
    """Run the plant's equations along a record.

    They start from its first row and run freely, driven by its inputs.
    """
    from reactorwatch.api.files import record_of_process
    from reactorwatch.api.simulation import report, simulate_along
    from reactorwatch.cli.progress import task
    from reactorwatch.description.choice import ProcessChoice
    from reactorwatch.records.write import WRITTEN_SUFFIXES, write_table

    choice = ProcessChoice(process)
    out = check_output(out, WRITTEN_SUFFIXES, (file, choice.file), force=force)
    measured, described = record_of_process(check_recording(file), plant, parse_columns(column), choice, table.stated)
    model = described.require_model()
    with task(f"simulating {file.name}"):
        simulated = simulate_along(measured, model, fault or [], settle)
        try:
            write_table(out, simulated)
        except InputError:
            print_report(report(measured, simulated, model, None, settle=settle, as_json=as_json), as_json=as_json)
            raise
    print_report(report(measured, simulated, model, out, settle=settle, as_json=as_json), as_json=as_json)


def backtest(
    *,
    files: Files,
    config: Settings = None,
    chosen: ProcessOptions,
    modes: Annotated[
        list[str] | None,
        Option(
            "--mode",
            help="A column that says how the plant is operated, without a process (repeatable, or with commas).",
        ),
    ] = None,
    plant: Plant = None,
    train: Annotated[
        Path | None, Option(help="A record to learn from, all of it; FILES are then watched from their first row.")
    ] = None,
    training: TrainingOptions,
    reference: Reference = None,
    column: Columns = None,
    out: Annotated[Path | None, Option("--out", "-o", help="Folder for a summary of several files.")] = None,
    rows: Annotated[
        Path | None, Option(help="A file (.csv) for each row of FILES, and whether an alarm is active.")
    ] = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    force: Force = False,
    as_json: Json = False,
    table: TableOptions,
) -> None:
    """Run the monitor over recordings at full speed."""
    from monitor_node.config import MonitorConfig
    from reactorwatch.cli.backtest_jobs import BACKTEST, BacktestOptions, train_on, write_rows
    from reactorwatch.cli.batch import SUMMARY, expand_files, make_jobs, run_jobs, unfit_lines
    from reactorwatch.cli.progress import task
    from reactorwatch.contract.keys import DEFAULT_PLANT
    from reactorwatch.records.write import check_output_folder
    from reactorwatch.runtime.config import read_settings, section

    named, choice = expand_files(files), chosen.choose(modes)
    sources = (*named, config, train, choice.file)
    if out is not None:
        check_output_folder(out, SUMMARY, sources, force=force)
    if rows is not None:
        rows = check_output(rows, ".csv", sources, force=force)
    if train is not None and training.is_given:
        raise InputError(f"--train {train}: all of it is the training; leave --training and --training-rows out")
    tables = read_settings(config)
    flags: dict[str, Any] = {"plant": plant or DEFAULT_PLANT, "reference": reference, "process": choice.process}
    if choice.outputs:
        choice.load()  # reports a column of two roles
        flags |= {"inputs": choice.inputs, "outputs": choice.outputs, "modes": choice.modes}
    flags |= training.flags(tables)
    settings = section(MonitorConfig, "monitor", tables, flags)
    asked = BacktestOptions(
        plant=plant,
        columns=parse_columns(column),
        process=choice,
        stated=table.stated,
        as_json=as_json,
        settings=settings,
        log_rows=rows is not None,
        is_one_of_many=len(named) > 1,
    )
    if train is not None:
        with task(f"learning from {train.name}"), unfit_lines(named, as_json=as_json):
            asked = replace(asked, trained=train_on(train, asked))
    run_jobs(
        BACKTEST,
        make_jobs(named, asked, elsewhere=scheduler is not None),
        out,
        processes=jobs,
        scheduler=scheduler,
        on_end=None if rows is None else partial(write_rows, rows),
    )


def diagnose(
    *,
    files: Files,
    out: Annotated[
        Path | None, Option("--out", "-o", help="Folder for a report; of several files, a folder each.")
    ] = None,
    tolerance: Annotated[
        str | None,
        Option(help="Differences that do not matter in practice, such as C=0.002,T=0.5 [a fiftieth of the range]."),
    ] = None,
    uncertain: Annotated[
        str | None, Option(help="Parameters that are known but to a standard deviation, such as K3=2%,Tf=0.5K [none].")
    ] = None,
    limit: Annotated[
        str | None,
        Option(
            "--limits",
            help="What a proposed experiment keeps to, such as qc=85..115,T=425..455 [a little beyond the record].",
        ),
    ] = None,
    process: Process = None,
    without: Annotated[
        list[str] | None, Option(help="A cause that is left out (repeatable); nothing takes its place.")
    ] = None,
    plant: Plant = None,
    column: Columns = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    force: Force = False,
    as_json: Json = False,
    table: TableOptions,
) -> None:
    """Find where a simulation differs from the record, and name the cause."""
    from reactorwatch.cli.batch import expand_files, run_jobs, unfit_lines
    from reactorwatch.cli.diagnosis import DiagnosisOptions
    from reactorwatch.cli.diagnosis_jobs import DIAGNOSIS, check_out, diagnosis_jobs
    from reactorwatch.description.choice import ProcessChoice

    named = expand_files(files)
    choice = ProcessChoice(process)
    check_out(named, out, choice.file, force=force)
    asked = DiagnosisOptions(
        plant=plant,
        columns=parse_columns(column),
        process=choice,
        stated=table.stated,
        as_json=as_json,
        uncertain=uncertain,
        tolerance=parse_tolerances(tolerance),
        limits=parse_limits(limit),
        without=split_names(without),
    )
    with unfit_lines(named, as_json=as_json):
        todo = diagnosis_jobs(named, out, asked, elsewhere=scheduler is not None)
    run_jobs(DIAGNOSIS, todo, out, processes=jobs, scheduler=scheduler)
