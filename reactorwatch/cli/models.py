"""Commands for linear models: `identify` from a record, and `linearise` from the equations."""

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from reactorwatch.cli.display import print_report
from reactorwatch.cli.option_groups import TableOptions
from reactorwatch.cli.options import (
    Columns,
    Inputs,
    Json,
    Plant,
    Process,
    RecordFile,
    check_recording,
    parse_columns,
    split_names,
)
from reactorwatch.cli.printing import print_text
from reactorwatch.errors import InputError


def identify(
    *,
    file: RecordFile,
    process: Annotated[
        str | None, Option(help="A process: a name in the catalogue, or a .toml, .py or extended.json file [cstr].")
    ] = None,
    inputs: Inputs = None,
    output: Annotated[
        list[str] | None,
        Option(help="An output to identify, each by a model of its own (repeatable) [T of cstr, else all]."),
    ] = None,
    model: Annotated[str, Option(help="arx, oe, armax, bj (Box-Jenkins), narx or noe (polynomials).")] = "arx",
    order: Annotated[int, Option(help="Lags of the output, each input and the disturbance.")] = 3,
    delay: Annotated[int, Option(help="Samples from a move of an input to its first effect.")] = 1,
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
    plant: Plant = None,
    column: Columns = None,
    as_json: Json = False,
    table: TableOptions,
) -> None:
    """Fit models of the outputs to one half, validate them on the other."""
    from reactorwatch.api.files import record
    from reactorwatch.cli import identification
    from reactorwatch.cli.batch import unfit_lines, write_remark
    from reactorwatch.cli.progress import task
    from reactorwatch.cli.unit_remarks import unit_remark
    from reactorwatch.errors import prefix_errors
    from reactorwatch.identification.identify import ModelForm

    described, outputs = identification.choose_outputs(process, split_names(inputs), split_names(output))
    form = ModelForm(
        model,
        order,
        delay,
        recursive=recursive,
        forgetting=forgetting,
    )
    if compare and (validate is not None or settle):
        raise InputError("--compare chooses by the second half of FILE: leave --validate and --settle out")
    measured, held_out = (
        None if path is None else record(check_recording(path), plant, parse_columns(column), described, table.stated)
        for path in (file, validate)
    )
    assert measured is not None
    equations = described.model
    remark = "" if equations is None else unit_remark(equations, measured.columns, measured.time_min)
    with task(f"identifying {file.name}"), unfit_lines([file], as_json=as_json), prefix_errors(file):
        if compare:
            text = identification.compare(measured, described.inputs, outputs, form, as_json=as_json)
        else:
            text = identification.fit(measured, described.inputs, outputs, form, held_out, settle, as_json=as_json)
    print_report(text, as_json=as_json)
    write_remark(file, remark)


def linearise(
    levels: Annotated[list[float], Argument(help="Level of each input, in its order and unit (qc of cstr).")],
    process: Process = None,
    step: Annotated[
        float | None,
        Option(help="Of each input, by which linear model and plant are compared [a tenth of its scale; qc: 1 l/min]."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Print the linear models at all steady states of constant inputs."""
    from reactorwatch.cli.linear_models import describe
    from reactorwatch.description.choice import ProcessChoice

    print_text(describe(ProcessChoice(process).load().require_model(), levels, step, as_json=as_json))
