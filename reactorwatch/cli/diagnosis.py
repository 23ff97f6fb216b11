"""Read and check a record, diagnose the simulation against it, and write the report."""

from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import msgspec
import numpy as np

from reactorwatch.api.diagnosis import Case, DiagnosisResult
from reactorwatch.api.files import record_of_process
from reactorwatch.api.report_origin import report_origin
from reactorwatch.cli.batch import FileOptions
from reactorwatch.cli.options import check_recording
from reactorwatch.diagnosis.parameter_priors import parse_priors
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.report.machine import report_object
from reactorwatch.diagnosis.result import Experiment
from reactorwatch.errors import UnfitRecordError
from reactorwatch.records.record import Record
from reactorwatch.records.write import atomic_write, fill_folder, write_table
from reactorwatch.runtime.model_file import write_extended_model

PAGE, OBJECT, MODEL, DRAWING = "report.html", "report.json", "extended.json", "report.rrd"
"""Files of a report."""

EXPERIMENT = "experiment.csv"
"""File of the proposed input, if there is one; it can drive a plant."""

REPORT = (PAGE, OBJECT, MODEL, DRAWING, EXPERIMENT)
"""The files that a report writes or deletes in its folder."""


@dataclass(frozen=True, kw_only=True)
class DiagnosisOptions(FileOptions):
    """Options of a diagnosis.

    Attributes:
        uncertain: parameters with a standard deviation, as text; None: none.
        tolerance: differences that do not matter, by output.
        limits: lowest and highest values of an experiment, by signal.
        without: causes that are left out, by name.
    """

    uncertain: str | None = None
    tolerance: dict[str, float] = field(default_factory=dict)
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    without: tuple[str, ...] = ()


def load_case(file: Path, asked: DiagnosisOptions) -> Case:
    """Read and check the record in a file, and load its model.

    Raises:
        InputError: the file cannot be read or diagnosed, or an uncertain parameter does not exist.
    """
    measured, process = record_of_process(
        check_recording(file), asked.plant, asked.columns, asked.process, asked.stated
    )
    model = process.require_model(UnfitRecordError)
    priors = {} if asked.uncertain is None else parse_priors(asked.uncertain, model)
    make_run(measured, model)
    return Case(measured, process, process.select_causes(asked.without), process.uncertain | priors)


def write_report(found: DiagnosisResult, file: Path, folder: Path, asked: DiagnosisOptions) -> None:
    """Write the files of a report; they appear together, or none does.

    Args:
        found: the diagnosis.
        file: the file as named.
        folder: folder of the report.
        asked: options of the diagnosis.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    # Imported only for a report: Rerun and Jinja take longer to import than most records to diagnose.
    from reactorwatch.diagnosis.report.page import as_page

    files = (str(file), str(folder / MODEL), str(folder / EXPERIMENT))
    settings = {
        "process": asked.process.process or found.model.name,
        "plant": asked.plant,
        "without": ", ".join(asked.without),
        "uncertain": asked.uncertain,
        "tolerance": asked.tolerance,
        "limits": asked.limits,
        "columns": asked.columns,
    }
    page = as_page(found, found.model, found.effects, *files, origin=report_origin(file, settings))
    report = report_object(found, str(file), found.seconds, found.zero)
    plain = msgspec.json.format(msgspec.json.encode(report), indent=2)
    with fill_folder(folder) as temporary:
        write_extended_model(temporary / MODEL, found.extended_model)
        if found.experiment is not None:
            _write_experiment(found.experiment, temporary / EXPERIMENT)
        if find_spec("rerun") is not None:  # an image of nodes that never draw is without
            from reactorwatch.cli.diagnosis_drawing import write_drawing

            write_drawing(found, found.model, found.record, temporary / DRAWING)
        for name, content in ((OBJECT, plain + b"\n"), (PAGE, page.encode())):
            with atomic_write(temporary / name) as written:
                written.write_bytes(content)
    if found.experiment is None:
        (folder / EXPERIMENT).unlink(missing_ok=True)  # from an earlier report


def _write_experiment(experiment: Experiment, path: Path) -> None:
    """Write the level from each change on, and at the end."""
    time_min, level = np.array([*experiment.input, (experiment.span_min, experiment.input[-1][1])]).T
    write_table(path, Record(time_min, {experiment.signal: level}, path.name))
