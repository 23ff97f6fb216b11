"""Commands on one's own data: info, backtest, identify, diagnose, causes, simulate, example.

Each has its options here, and its work in the file of its name.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from reactorwatch.cli.display import json_line, print_lines, print_report, task
from reactorwatch.cli.option_groups import (
    FILE,
    ProcessOption,
    ProcessOptions,
    RecordOptions,
    SettingsOptions,
    TableOptions,
    TrainingOptions,
    fold,
)
from reactorwatch.cli.options import (
    Files,
    Force,
    Jobs,
    Json,
    RecordFile,
    Reference,
    Scheduler,
    check_output,
    check_recording,
    parse_limits,
    parse_tolerances,
    split_names,
)
from reactorwatch.errors import InputError
from reactorwatch.records.write import check_output_file


def info(
    *,
    file: Annotated[Path, Argument(help="A recording (.mcap), a folder of them, or a table.")],
    chosen: ProcessOptions,
    as_json: Json = False,
    table: TableOptions,
) -> None:
    """Show the contents of a recording, and missing messages; or how a table is read, and what is in it."""
    from reactorwatch.cli.info import info_object, info_text, table_object, table_text
    from reactorwatch.description.read import read_signals, resample_rows
    from reactorwatch.records.decode import check_workbook, is_table
    from reactorwatch.records.read import read_table
    from recorder.tools.inspect import inspect

    choice = chosen.choose()
    with task(f"reading {file.name}"):
        check_workbook(check_recording(file), table.sheet)
        if is_table(file) and not file.is_dir():
            record = (
                resample_rows(read_table(file, None, table.file_format), None, table.file_format)
                if choice.is_default
                else read_signals(file, choice, None, table.file_format)
            )
            text = json_line(table_object(record, file)) if as_json else table_text(record, file)
        elif table.resample is not None:
            raise InputError(f"--resample: info shows the recording {file} as it is; export it with --resample")
        else:
            seen = inspect(file)
            if not choice.is_default:
                seen = replace(seen, processes=dict.fromkeys(seen.overview.runs, choice.load()))
            text = json_line(info_object(seen, file)) if as_json else info_text(seen, file)
    print_report(text, as_json=as_json)


def backtest(
    *,
    files: Files,
    settings_file: SettingsOptions,
    chosen: ProcessOptions,
    modes: Annotated[
        list[str] | None,
        fold(
            FILE,
            "--mode",
            help="A column that says how the plant is operated, without a process (repeatable, or with commas).",
        ),
    ] = None,
    train: Annotated[
        Path | None, Option(help="A record to learn from, all of it; FILES are then watched from their first row.")
    ] = None,
    training: TrainingOptions,
    reference: Reference = None,
    out: Annotated[Path | None, Option("--out", "-o", help="Folder for a summary of several files.")] = None,
    rows: Annotated[
        Path | None, Option(help="A file (.csv) for each row of FILES, and whether an alarm is active.")
    ] = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    force: Force = False,
    as_json: Json = False,
    table: RecordOptions,
) -> None:
    """Run the monitor over recordings at full speed."""
    from monitor_node.config import MonitorConfig
    from reactorwatch.cli.backtest import BACKTEST, BacktestOptions, train_on, write_rows
    from reactorwatch.cli.batch import SUMMARY, expand_files, make_jobs, run_jobs, unfit_lines
    from reactorwatch.contract.keys import DEFAULT_PLANT
    from reactorwatch.records.write import check_output_folder
    from reactorwatch.runtime.config import read_settings, section

    named, choice = expand_files(files), chosen.choose(modes)
    sources = (*named, settings_file.config, train, choice.file)
    if out is not None:
        check_output_folder(out, SUMMARY, sources, force=force)
    if rows is not None:
        rows = check_output(rows, ".csv", sources, force=force)
    if train is not None and training.is_given:
        raise InputError(f"--train {train}: all of it is the training; leave --training and --training-rows out")
    tables = read_settings(settings_file.config)
    flags: dict[str, Any] = {"plant": table.plant or DEFAULT_PLANT, "reference": reference, "process": choice.process}
    if choice.outputs:
        choice.load()  # reports a column of two roles
        flags |= {"inputs": choice.inputs, "outputs": choice.outputs, "modes": choice.modes}
    flags |= training.flags(tables)
    settings = section(MonitorConfig, "monitor", tables, flags)
    asked = BacktestOptions(
        plant=table.plant,
        columns=table.columns,
        process=choice,
        stated=table.file_format,
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


def identify(
    *,
    file: RecordFile,
    process: Annotated[
        str | None, Option(help="A process: a name in the catalogue, or a .toml, .py or extended.json file [cstr].")
    ] = None,
    inputs: Annotated[
        list[str] | None,
        fold(FILE, "--input", help="A column that is an input, without a process (repeatable, or with commas)."),
    ] = None,
    output: Annotated[
        list[str] | None,
        Option(help="An output to identify, each by a model of its own (repeatable) [T of cstr, else all]."),
    ] = None,
    model: Annotated[str, Option(help="arx, oe, armax, bj (Box-Jenkins), narx or noe (polynomials).")] = "arx",
    order: Annotated[int, Option(help="Lags of the output, each input and the disturbance.")] = 3,
    delay: Annotated[
        str | None,
        Option(
            help="Samples from a move of an input to its first effect: N, auto (searched), or u1=3,u2=15 [1; with "
            "--compare auto, beside 1]."
        ),
    ] = None,
    validate: Annotated[
        Path | None, Option(help="A record to validate on; all of FILE is then fitted [the second half].")
    ] = None,
    settle: Annotated[
        int, Option(help="Held-out rows that may set the state of the free run, and are left out of fits.")
    ] = 0,
    recursive: Annotated[bool, Option("--recursive", help="Learn arx row by row, as the monitor does.")] = False,
    forgetting: Annotated[
        float, Option(help="With --recursive: weight of a row relative to its successor, in (0, 1].")
    ] = 1.0,
    compare: Annotated[
        bool, Option("--compare", help="Compare ARX and OE of orders 1 to --order, and choose.")
    ] = False,
    as_json: Json = False,
    table: RecordOptions,
) -> None:
    """Fit models of the outputs to one half, validate them on the other."""
    from reactorwatch.api.files import record
    from reactorwatch.cli import identify as identification
    from reactorwatch.cli.batch import unfit_lines, unit_remark, write_remark
    from reactorwatch.errors import prefix_errors
    from reactorwatch.identification.identify import ModelForm

    described, outputs = identification.choose_outputs(process, split_names(inputs), split_names(output))
    form = ModelForm(
        model,
        order,
        identification.read_delay(delay or "1"),
        recursive=recursive,
        forgetting=forgetting,
    )
    if compare and (validate is not None or settle):
        raise InputError("--compare chooses by the second half of FILE: leave --validate and --settle out")
    measured, held_out = (
        None
        if path is None
        else record(check_recording(path), table.plant, table.columns, described, table.file_format)
        for path in (file, validate)
    )
    assert measured is not None
    equations = described.model
    remark = "" if equations is None else unit_remark(equations, measured.columns, measured.time_min)
    with task(f"identifying {file.name}"), unfit_lines([file], as_json=as_json), prefix_errors(file):
        if compare:
            delays = identification.read_delay(delay or "auto")
            text = identification.compare(measured, described.inputs, outputs, order, delays, as_json=as_json)
        else:
            text = identification.fit(measured, described.inputs, outputs, form, held_out, settle, as_json=as_json)
    print_report(text, as_json=as_json)
    write_remark(file, remark)


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
    chosen: ProcessOption,
    without: Annotated[
        list[str] | None, Option(help="A cause that is left out (repeatable); nothing takes its place.")
    ] = None,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    force: Force = False,
    as_json: Json = False,
    table: RecordOptions,
) -> None:
    """Find where a simulation differs from the record, and name the cause."""
    from reactorwatch.cli.batch import expand_files, run_jobs, unfit_lines
    from reactorwatch.cli.diagnose import DIAGNOSING, DiagnosisOptions, check_out, diagnosis_jobs

    named = expand_files(files)
    choice = chosen.choose()
    check_out(named, out, choice.file, force=force)
    asked = DiagnosisOptions(
        plant=table.plant,
        columns=table.columns,
        process=choice,
        stated=table.file_format,
        as_json=as_json,
        uncertain=uncertain,
        tolerance=parse_tolerances(tolerance),
        limits=parse_limits(limit),
        without=split_names(without),
    )
    with unfit_lines(named, as_json=as_json):
        todo = diagnosis_jobs(named, out, asked, elsewhere=scheduler is not None)
    run_jobs(DIAGNOSING, todo, out, processes=jobs, scheduler=scheduler)


def causes(
    *,
    chosen: ProcessOption,
    record: Annotated[
        Path | None, Option(help="A record whose inputs, times and noise count [a usual excitation].")
    ] = None,
    as_json: Json = False,
    table: RecordOptions,
) -> None:
    """Show which causes the sensors distinguish, and from which size on each is seen."""
    from plant_node.config import resolutions
    from reactorwatch.api.files import record_of_process
    from reactorwatch.cli.causes import as_json_text, as_matrix
    from reactorwatch.diagnosis.identifiability import identifiability
    from reactorwatch.diagnosis.record_checks import excite, make_run

    choice = chosen.choose()
    if record is None:
        described = choice.load()
        model = described.require_model()
        measured = excite(model, resolutions(described))
    else:
        path = check_recording(record)
        measured, described = record_of_process(path, table.plant, table.columns, choice, table.file_format)
        model = described.require_model()
    run = make_run(measured, model)
    with task(f"comparing the causes of {described.name}"):
        found = identifiability(model, described.causes, run)
    show = as_json_text if as_json else as_matrix
    print_lines(*show(found, described.name, run.time_min.size).split("\n"))  # its matrix is not to be wrapped


def simulate(
    *,
    file: RecordFile,
    out: Annotated[Path, Option("--out", "-o", help="The file to write (.csv or another table).")],
    fault: Annotated[
        list[str] | None, Option(help="A fault, as cause:profile:size@onset, onset in the file's time.")
    ] = None,
    chosen: ProcessOption,
    settle: Annotated[
        int, Option(help="First rows that set the state it starts from, and are left out of errors.")
    ] = 0,
    force: Force = False,
    as_json: Json = False,
    table: RecordOptions,
) -> None:
    """Run the plant's equations along a record.

    They start from its first row and run freely, driven by its inputs.
    """
    from reactorwatch.api.files import record_of_process
    from reactorwatch.api.simulation import report, simulate_along
    from reactorwatch.records.write import WRITTEN_SUFFIXES, write_table
    from reactorwatch.sentences.models import simulation_text

    choice = chosen.choose()
    out = check_output(out, WRITTEN_SUFFIXES, (file, choice.file), force=force)
    measured, described = record_of_process(
        check_recording(file), table.plant, table.columns, choice, table.file_format
    )
    model = described.require_model()
    with task(f"simulating {file.name}"):
        simulated = simulate_along(measured, model, fault or [], settle)
        try:
            write_table(out, simulated)
            not_written = None
        except InputError as error:
            not_written = error
    found = report(measured, simulated, model, None if not_written else out, settle)
    print_report(json_line(found.to_dict()) if as_json else simulation_text(found), as_json=as_json)
    if not_written is not None:
        raise not_written


def example(
    name: Annotated[
        str,
        Argument(
            help="Of cstr: sound, leak, fouling, analyser_drift, two_causes or unknown (a law in no catalogue); "
            "three_tanks or cascaded_tanks.",
        ),
    ],
    out: Annotated[Path, Option("--out", "-o", help="The file to write; the truth is written beside it.")],
    seed: Annotated[int, Option(help="Of the input and the noise.", min=0, max=2**63 - 1)] = 3,
    force: Force = False,
) -> None:
    """Write a simulated sample record (.csv, .csv.gz, .xlsx or .parquet), its truth in FILE.truth.json."""
    import msgspec

    from reactorwatch.cli.example import make_example
    from reactorwatch.records.write import WRITTEN_SUFFIXES, atomic_write, write_table

    out = check_output(out, WRITTEN_SUFFIXES, (), force=force)
    beside = check_output_file(out.with_name(f"{out.name}.truth.json"), force=force)
    with task(f"simulating {name}"):
        record, truth, meaning = make_example(name, seed)
    write_table(out, record)
    with atomic_write(beside) as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(truth)) + b"\n")
    print_lines(f"wrote {out}: {record.rows} rows; {meaning}", f"wrote {beside}")
