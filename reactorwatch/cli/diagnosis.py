"""Read and check a record, diagnose the simulation against it, and write the report."""

import time
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TypeAlias

import msgspec
import numpy as np

from reactorwatch.api.files import described_process, process_on_clock, record
from reactorwatch.api.report_origin import report_origin
from reactorwatch.cli.options import check_recording
from reactorwatch.description.choice import ProcessChoice
from reactorwatch.description.process import Process
from reactorwatch.description.toml_file import add_description
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.parameter_priors import parse_priors
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.report.machine import report_object
from reactorwatch.diagnosis.result import Diagnosis, Experiment
from reactorwatch.process.effect import Effect
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.records.folder import fill_folder
from reactorwatch.records.record import Record
from reactorwatch.records.write_table import write_table
from reactorwatch.runtime.model_file import write_extended_model

PAGE, OBJECT, MODEL, DRAWING = "report.html", "report.json", "extended.json", "report.rrd"
"""Files of a report."""

EXPERIMENT = "experiment.csv"
"""File of the proposed input, if there is one; it can drive a plant."""

REPORT = (PAGE, OBJECT, MODEL, DRAWING, EXPERIMENT)
"""The files that a report writes or deletes in its folder."""

Limits: TypeAlias = dict[str, tuple[float, float]]


@dataclass(frozen=True)
class DiagnosisOptions:
    """Options of a diagnosis, the same for all files.

    Attributes:
        plant: plant in recordings.
        columns: names of columns by signal.
        process: the process.
        uncertain: parameters with a standard deviation, as text; None: none.
        tolerance: differences that do not matter, by output.
        limits: lowest and highest values of an experiment, by signal.
        stated: statements about the form of a table.
        without: causes that are left out, by name.
    """

    plant: str | None = None
    columns: dict[str, str] = field(default_factory=dict)
    process: ProcessChoice = field(default_factory=ProcessChoice)
    uncertain: str | None = None
    tolerance: dict[str, float] = field(default_factory=dict)
    limits: Limits = field(default_factory=dict)
    stated: FileFormat = GUESS
    without: tuple[str, ...] = ()


@dataclass(frozen=True)
class Case:
    """A record to be diagnosed.

    Attributes:
        file: the file as named.
        measured: the record.
        model: the simulation, on the clock of the record.
        folder: folder for the report; None: no report.
        effects: possible causes.
        uncertain: standard deviations of uncertain parameters, by name.
        asked: options of the diagnosis.
        process: the process, for the file of the extended model; None: that file describes no signals.
    """

    file: Path
    measured: Record
    model: ProcessModel
    effects: tuple[Effect, ...]
    folder: Path | None
    uncertain: dict[str, float] = field(default_factory=dict)
    asked: DiagnosisOptions = field(default_factory=DiagnosisOptions)
    process: Process | None = None


def load_case(file: Path, folder: Path | None, asked: DiagnosisOptions, at: Path | None = None) -> Case:
    """Read and check the record in a file, and load its model.

    Args:
        file: the file as named.
        folder: folder for the report; None: no report.
        asked: options of the diagnosis.
        at: path of the file; None: `file`.

    Raises:
        InputError: the file cannot be read or diagnosed, or an uncertain parameter does not exist.
    """
    path = check_recording(at or file)
    described = described_process(path, asked.plant, asked.process)
    measured = record(path, asked.plant, asked.columns, described, stated=asked.stated)
    simulated = process_on_clock(asked.process, described, measured.zero_ns)
    model = simulated.require_model()
    known = described.uncertain
    if asked.uncertain is not None:
        known = known | parse_priors(asked.uncertain, model)
    make_run(measured, model)
    return Case(file, measured, model, simulated.select_causes(asked.without), folder, known, asked, simulated)


def run_diagnosis(
    case: Case, tolerance: dict[str, float] | None = None, limits: Limits | None = None
) -> tuple[Diagnosis, float]:
    """Diagnose a record; returns the diagnosis and the seconds that it took.

    Raises:
        InputError: invalid tolerances or limits.
    """
    started = time.monotonic()
    diagnosis = diagnose(case.measured, case.model, case.effects, tolerance, case.uncertain, limits)
    if case.process is not None:
        diagnosis = replace(diagnosis, extended_model=add_description(diagnosis.extended_model, case.process))
    return diagnosis, time.monotonic() - started


def write_report(diagnosis: Diagnosis, case: Case, seconds: float) -> None:
    """Write the files of a report; they appear together, or none does.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    # Imported only for a report: Rerun and Jinja take longer to import than most records to diagnose.
    from reactorwatch.diagnosis.report.page import as_page

    assert case.folder is not None
    folder = case.folder
    files = (str(case.file), str(folder / MODEL), str(folder / EXPERIMENT))
    asked = case.asked
    settings = {
        "process": asked.process.process or case.model.name,
        "plant": asked.plant,
        "without": ", ".join(asked.without),
        "uncertain": asked.uncertain,
        "tolerance": asked.tolerance,
        "limits": asked.limits,
        "columns": asked.columns,
    }
    origin = report_origin(case.file, settings)
    page = as_page(diagnosis, case.model, case.effects, *files, origin=origin)
    plain = msgspec.json.format(
        msgspec.json.encode(report_object(diagnosis, str(case.file), seconds, case.measured.zero)), indent=2
    )
    with fill_folder(folder) as temporary:
        write_extended_model(temporary / MODEL, diagnosis.extended_model)
        if diagnosis.experiment is not None:
            _write_experiment(diagnosis.experiment, temporary / EXPERIMENT)
        if find_spec("rerun") is not None:  # an image of nodes that never draw is without
            from reactorwatch.cli.diagnosis_drawing import write_drawing

            write_drawing(diagnosis, case.model, case.measured, temporary / DRAWING)
        for name, content in ((OBJECT, plain + b"\n"), (PAGE, page.encode())):
            with atomic_write(temporary / name) as file:
                file.write_bytes(content)
    if diagnosis.experiment is None:
        (folder / EXPERIMENT).unlink(missing_ok=True)  # from an earlier report


def _write_experiment(experiment: Experiment, path: Path) -> None:
    """Write the level from each change on, and at the end."""
    time_min, level = np.array([*experiment.input, (experiment.span_min, experiment.input[-1][1])]).T
    write_table(path, Record(time_min, {experiment.signal: level}, path.name))
