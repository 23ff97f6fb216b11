"""`causes`: the causes that the sensors and an excitation of a process distinguish."""

from pathlib import Path
from typing import Annotated

from typer import Option

from reactorwatch.cli.option_groups import TableOptions
from reactorwatch.cli.options import Columns, Json, Plant, Process, check_recording, parse_columns
from reactorwatch.cli.printing import print_text


def causes(
    *,
    process: Process = None,
    record: Annotated[
        Path | None, Option(help="A record whose inputs, times and noise count [a usual excitation].")
    ] = None,
    plant: Plant = None,
    column: Columns = None,
    as_json: Json = False,
    table: TableOptions,
) -> None:
    """Show which causes the sensors distinguish, and from which size on each is seen."""
    from plant_node.config import resolutions
    from reactorwatch.api.files import record_of_process
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
        measured = excite(model, resolutions(described))
    else:
        path, columns = check_recording(record), parse_columns(column)
        measured, described = record_of_process(path, plant, columns, choice, table.stated)
        model = described.require_model()
    run = make_run(measured, model)
    with task(f"comparing the causes of {described.name}"):
        found = identifiability(model, described.causes, run)
    show = as_json_text if as_json else as_matrix
    print_text(show(found, described.name, run.time_min.size))
