"""`causes`: the causes that the sensors and an excitation of a process distinguish."""

from pathlib import Path
from typing import Annotated

import typer

from reactorwatch.cli.options import Columns, Json, Plant, Process, check_recording, parse_columns
from reactorwatch.cli.printing import print_text
from reactorwatch.cli.table_options import take_table_options
from reactorwatch.records.file_format import GUESS, FileFormat


def register_commands(app: typer.Typer) -> None:
    """Register the command."""
    app.command("causes")(take_table_options(causes))


def causes(
    process: Process = None,
    record: Annotated[
        Path | None,
        typer.Option(
            "--record", help="A record whose inputs, times and noise count [a usual excitation].", show_default=False
        ),
    ] = None,
    plant: Plant = None,
    column: Columns = None,
    as_json: Json = False,
    stated: FileFormat = GUESS,
) -> None:
    """Show which causes the sensors distinguish, and from which size on each is seen."""
    from reactorwatch.api.files import described_process, process_on_clock
    from reactorwatch.api.files import record as read_record
    from reactorwatch.cli.causes_report import as_json_text, as_matrix
    from reactorwatch.cli.progress import task
    from reactorwatch.description.choice import ProcessChoice
    from reactorwatch.diagnosis.identifiability import identifiability
    from reactorwatch.diagnosis.record_checks import make_run
    from reactorwatch.diagnosis.usual_excitation import excite

    choice = ProcessChoice(process)
    if record is None:
        described = choice.load()
        model = described.require_model()
        measured = excite(model)
    else:
        path = check_recording(record)
        described = described_process(path, plant, choice)
        measured = read_record(path, plant, parse_columns(column), described, stated=stated)
        described = process_on_clock(choice, described, measured.zero_ns)
        model = described.require_model()
    run = make_run(measured, model)
    with task(f"comparing the causes of {described.name}"):
        found = identifiability(model, described.causes, run)
    show = as_json_text if as_json else as_matrix
    print_text(show(found, described.name, run.time_min.size))
