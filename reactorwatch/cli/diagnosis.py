"""What the simulation gets wrong of a record: read, checked, diagnosed, and written down as a report."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import msgspec
import numpy as np

from reactorwatch.cli.options import existing_recording
from reactorwatch.cli.read_record import process_model, record, signals_of
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.parameter_priors import parse_priors
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.report.machine import report_object
from reactorwatch.diagnosis.result import Diagnosis, Experiment
from reactorwatch.process import effects_of
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.atomic import replacing
from reactorwatch.records.csv_file import write_csv
from reactorwatch.records.folder import filling
from reactorwatch.records.record import Record
from reactorwatch.runtime.model_file import write_extended_model

PAGE, OBJECT, MODEL, DRAWING = "report.html", "report.json", "extended.json", "report.rrd"
"""What a report is made of."""

PLANT = "cstr"
"""The process that the plant node simulates and the monitor watches."""

EXPERIMENT = "experiment.csv"
"""The proposed input, if there is one: it can drive a plant."""

REPORT = (PAGE, OBJECT, MODEL, DRAWING, EXPERIMENT)
"""The files that a report writes or deletes in its folder."""

Limits: TypeAlias = dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Asked:
    """What is asked about all files alike, as it was given.

    Attributes:
        plant: in recordings.
        columns: their names by signal.
        model: file of an extended model; None: the nominal reactor.
        uncertain: which parameters are known but to a standard deviation, as text; None: none.
        tolerance: differences that do not matter, by output.
        limits: that an experiment keeps to, by signal.
        as_json: whether it is to be said to a machine.
    """

    plant: str | None = None
    columns: dict[str, str] = field(default_factory=dict)
    model: Path | None = None
    uncertain: str | None = None
    tolerance: dict[str, float] = field(default_factory=dict)
    limits: Limits = field(default_factory=dict)
    as_json: bool = False


@dataclass(frozen=True)
class Case:
    """A record to be diagnosed.

    Attributes:
        file: as it was named.
        measured: the record.
        model: the simulation, its clock that of the record.
        folder: for the report; None: none is wanted.
        uncertain: parameters that are known but to a standard deviation.
    """

    file: Path
    measured: Record
    model: ProcessModel
    folder: Path | None
    uncertain: dict[str, float] = field(default_factory=dict)


def case_of(file: Path, folder: Path | None, asked: Asked, at: Path | None = None) -> Case:
    """The record in a file, read and checked, and the simulation of it.

    Args:
        file: as it was named.
        folder: for the report; None: none is wanted.
        asked: about it.
        at: where the file is; None: where its name says.

    Raises:
        InputError: the file cannot be read or diagnosed, or what is uncertain is no parameter.
    """
    measured = record(existing_recording(at or file), asked.plant, asked.columns, signals_of(asked.model))
    process = process_model(asked.model, measured)
    known = parse_priors(asked.uncertain, process) if asked.uncertain is not None else {}
    make_run(measured, process)
    return Case(file, measured, process, folder, known)


def diagnosed(
    case: Case, tolerance: dict[str, float] | None = None, limits: Limits | None = None
) -> tuple[Diagnosis, float]:
    """The diagnosis of a record and the seconds that it took.

    Raises:
        InputError: a tolerance or limits that cannot be.
    """
    began = time.monotonic()
    diagnosis = diagnose(case.measured, case.model, None, tolerance, case.uncertain, limits)
    return diagnosis, time.monotonic() - began


def write_report(diagnosis: Diagnosis, case: Case, seconds: float) -> None:
    """Write the files of a report; they appear together, or none does.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    # Imported where a report is wanted: Rerun and Jinja take longer to import than most records to diagnose.
    from reactorwatch.cli.diagnosis_drawing import write_drawing
    from reactorwatch.diagnosis.report.page import as_page

    assert case.folder is not None
    folder = case.folder
    catalogue, on_the_bus = effects_of(case.model), case.model.name == PLANT
    files = (str(case.file), str(folder / MODEL), str(folder / EXPERIMENT))
    page = as_page(diagnosis, case.model, catalogue, *files, on_the_bus=on_the_bus)
    plain = msgspec.json.format(
        msgspec.json.encode(report_object(diagnosis, str(case.file), seconds, case.measured.zero)), indent=2
    )
    with filling(folder, "--out") as temporary:
        write_extended_model(temporary / MODEL, diagnosis.extended_model)
        if diagnosis.experiment is not None:
            _write_experiment(diagnosis.experiment, temporary / EXPERIMENT)
        write_drawing(diagnosis, case.model, case.measured, temporary / DRAWING)
        for name, content in ((OBJECT, plain + b"\n"), (PAGE, page.encode())):
            with replacing(temporary / name) as file:
                file.write_bytes(content)
    if diagnosis.experiment is None:
        (folder / EXPERIMENT).unlink(missing_ok=True)  # of an earlier report


def _write_experiment(experiment: Experiment, path: Path) -> None:
    """Write the level from each change on, and at the end."""
    time_min, level = np.array([*experiment.input, (experiment.span_min, experiment.input[-1][1])]).T
    write_csv(path, Record(time_min, {experiment.signal: level}, path.name))
