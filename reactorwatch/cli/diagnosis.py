"""`diagnose`: what the simulation gets wrong of some records, said, and written down as a report.

All files are read and checked before the first is diagnosed. So a file that cannot be used is told at once, before
anything else is said or written, and not after minutes of others.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import msgspec
import numpy as np

from diagnosis.diagnose import diagnose
from diagnosis.record_checks import run_of
from diagnosis.report.machine import as_object, with_differences
from diagnosis.report.page import as_page
from diagnosis.report.plain import as_text
from diagnosis.result import Diagnosis, Experiment
from diagnosis.uncertain import stated
from reactorwatch.cli.diagnosis_drawing import write_drawing
from reactorwatch.cli.progress import bar, task
from reactorwatch.cli.sources import process_model, record, signals_of
from reactorwatch.errors import InputError
from reactorwatch.process import effects_of
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.atomic import replacing
from reactorwatch.records.csv_file import write_csv
from reactorwatch.records.record import Record
from reactorwatch.runtime.model_file import write_extended_model

PAGE, OBJECT, MODEL, DRAWING = "report.html", "report.json", "extended.json", "report.rrd"
"""What a report is made of."""

PLANT = "cstr"
"""The process that the plant node simulates and the monitor watches."""

EXPERIMENT = "experiment.csv"
"""The proposed input, if there is one: it can drive a plant."""

Limits: TypeAlias = dict[str, tuple[float, float]]


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


def cases(
    files: Sequence[Path],
    plant: str | None,
    columns: dict[str, str],
    model: Path | None,
    out: Path | None,
    uncertain: str | None = None,
) -> list[Case]:
    """The records in the files, read and checked.

    Args:
        files: .csv or .mcap.
        plant: in them.
        columns: their names by signal.
        model: file of an extended model; None: the nominal reactor.
        out: folder for the report; of several files, each gets a folder in it.
        uncertain: which parameters are known but to a standard deviation, as text; None: none.

    Raises:
        InputError: a file cannot be read or diagnosed, the folder cannot be one, or what is uncertain is no parameter.
    """
    if out is not None and out.exists() and not out.is_dir():
        raise InputError(f"--out {out}: is a file, the name of a folder was expected")
    signals = signals_of(model)
    found = []
    for file, folder in zip(files, _folders(files, out), strict=True):
        measured = record(file, plant, columns, signals)
        process = process_model(model, measured)
        known = stated(uncertain, process) if uncertain is not None else {}
        run_of(measured, process)
        found.append(Case(file, measured, process, folder, known))
    return found


def results(found: Sequence[Case], tolerance: dict[str, float], limits: Limits, *, as_json: bool) -> Iterator[str]:
    """Diagnose one after the other, write its report if there is a folder for it, and yield what is to be said.

    Raises:
        InputError: a tolerance or limits that cannot be, or a folder that cannot be written to.
    """
    if len(found) == 1:
        with task(f"diagnosing {found[0].file.name}"):
            said = _result(found[0], tolerance, limits, as_json=as_json)
        yield said
        return
    with bar("diagnosing", len(found)) as advance:
        for number, case in enumerate(found):
            advance(number, f"diagnosing {case.file.name}")
            yield _result(case, tolerance, limits, as_json=as_json)


def diagnosed(
    case: Case, tolerance: dict[str, float] | None = None, limits: Limits | None = None
) -> tuple[Diagnosis, float]:
    """The diagnosis of a record and the seconds that it took; its report is written if there is a folder for it.

    Raises:
        InputError: as `results`.
    """
    began = time.monotonic()
    diagnosis = diagnose(case.measured, case.model, None, tolerance, case.uncertain, limits)
    seconds = time.monotonic() - began
    if case.folder is not None:
        write_report(diagnosis, case, seconds)
    return diagnosis, seconds


def write_report(diagnosis: Diagnosis, case: Case, seconds: float) -> None:
    """Write the files of a report; each appears whole or not at all.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    folder = case.folder
    assert folder is not None
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"--out {folder}: the folder cannot be made: {error.strerror}") from error
    catalogue, on_the_bus = effects_of(case.model), case.model.name == PLANT
    files = (str(case.file), str(folder / MODEL), str(folder / EXPERIMENT))
    page = as_page(diagnosis, case.model, catalogue, *files, on_the_bus=on_the_bus)
    plain = msgspec.json.format(msgspec.json.encode(with_differences(diagnosis, str(case.file), seconds)), indent=2)
    write_extended_model(folder / MODEL, diagnosis.extended_model)
    _write_experiment(diagnosis.experiment, folder / EXPERIMENT)
    write_drawing(diagnosis, case.model, case.measured, folder / DRAWING)
    for name, content in ((OBJECT, plain + b"\n"), (PAGE, page.encode())):
        with replacing(folder / name) as temporary:
            temporary.write_bytes(content)


def _write_experiment(experiment: Experiment | None, path: Path) -> None:
    """The level from each change on, and at the end; one of an earlier report goes."""
    if experiment is None:
        path.unlink(missing_ok=True)
        return
    time_min, level = np.array([*experiment.input, (experiment.span_min, experiment.input[-1][1])]).T
    write_csv(path, Record(time_min, {experiment.signal: level}, path.name))


def _result(case: Case, tolerance: dict[str, float], limits: Limits, *, as_json: bool) -> str:
    diagnosis, seconds = diagnosed(case, tolerance, limits)
    if as_json:
        return msgspec.json.encode(as_object(diagnosis, str(case.file), seconds)).decode()
    said = as_text(diagnosis, str(case.file), effects_of(case.model))
    if case.folder is None:
        return said
    if diagnosis.experiment is not None:
        said += f"\n  input       {case.folder / EXPERIMENT}"
    return f"{said}\n  report      {case.folder / PAGE}"


def _folders(files: Sequence[Path], out: Path | None) -> list[Path | None]:
    """One for each file: named after it, if there are several."""
    if out is None or len(files) == 1:
        return [out] * len(files)
    names: list[str] = []
    for file in files:
        same = sum(name == file.stem or name.startswith(f"{file.stem}-") for name in names)
        names.append(file.stem if not same else f"{file.stem}-{same + 1}")
    return [out / name for name in names]
