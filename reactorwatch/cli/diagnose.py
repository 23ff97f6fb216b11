"""`diagnose`: one job for each file: read, diagnose, write the report and its drawing; a summary of several files.

Errors in the options, not in a file, are raised before the first job.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from reactorwatch.api.diagnosis import Case, DiagnosisResult, diagnose_case
from reactorwatch.api.files import record_of_process
from reactorwatch.api.shown import report_origin
from reactorwatch.arrays import Array
from reactorwatch.cli.batch import SUMMARY, FileOptions, Job, JobKind, JobResult, Row, as_table, make_jobs
from reactorwatch.cli.display import json_line
from reactorwatch.cli.options import check_recording
from reactorwatch.diagnosis.experiment.inputs import check_limits
from reactorwatch.diagnosis.parameter_priors import parse_priors
from reactorwatch.diagnosis.practical_significance import check_tolerance
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.report.panels import interval
from reactorwatch.diagnosis.result import SD_95, Cause, Curves, Diagnosis, Experiment
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.process.model import ProcessModel
from reactorwatch.progress import report_stage
from reactorwatch.records.decode import is_table
from reactorwatch.records.record import Record, to_time_ns
from reactorwatch.records.write import atomic_write, check_output_folder, fill_folder, write_table
from reactorwatch.sentences.diagnosis import diagnosis_text
from reactorwatch.sentences.numbers import percent
from recorder.panels.base import ALARM, INPUT, LIMIT, MEASURED, PREDICTED, Colour, Series, TimePlot

PAGE, OBJECT, MODEL, DRAWING = "report.html", "report.json", "extended.json", "report.rrd"
"""Files of a report."""

EXPERIMENT = "experiment.csv"
"""File of the proposed input, if there is one; it can drive a plant."""

REPORT = (PAGE, OBJECT, MODEL, DRAWING, EXPERIMENT)
"""The files that a report writes or deletes in its folder."""


@dataclass(frozen=True, kw_only=True)
class DiagnosisOptions(FileOptions):
    """Options of a diagnosis."""

    uncertain: str | None = None
    tolerance: dict[str, float] = field(default_factory=dict)  # differences that do not matter, by output
    limits: dict[str, tuple[float, float]] = field(default_factory=dict)  # of an experiment, by signal
    without: tuple[str, ...] = ()


def load_case(file: Path, asked: DiagnosisOptions) -> Case:
    """Read and check the record in a file, and load its model."""
    measured, process = record_of_process(
        check_recording(file), asked.plant, asked.columns, asked.process, asked.stated
    )
    model = process.require_model(UnfitRecordError)
    priors = {} if asked.uncertain is None else parse_priors(asked.uncertain, model)
    make_run(measured, model)
    return Case(measured, process, process.select_causes(asked.without), process.uncertain | priors, str(file))


def write_report(found: DiagnosisResult, file: Path, folder: Path, asked: DiagnosisOptions) -> None:
    """Write the files of a report; they appear together, or none does."""
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
    page = as_page(found.result, found.model, found.effects, *files, origin=report_origin(file, settings))
    plain = msgspec.json.format(msgspec.json.encode(found.to_dict()), indent=2)
    with fill_folder(folder) as temporary:
        write_extended_model(temporary / MODEL, found.extended_model)
        if found.experiment is not None:
            _write_experiment(found.experiment, temporary / EXPERIMENT)
        if find_spec("rerun") is not None:  # an image of nodes that never draw is without
            write_drawing(found.result, found.model, found.record, temporary / DRAWING)
        for name, content in ((OBJECT, plain + b"\n"), (PAGE, page.encode())):
            with atomic_write(temporary / name) as written:
                written.write_bytes(content)
    if found.experiment is None:
        (folder / EXPERIMENT).unlink(missing_ok=True)  # from an earlier report


def _write_experiment(experiment: Experiment, path: Path) -> None:
    """Write the levels of all inputs from each change on, and at the end."""
    moves = experiment.input if isinstance(experiment.input, dict) else {experiment.signal: experiment.input}
    time_min, level = np.array([*moves[experiment.signal], (experiment.span_min, moves[experiment.signal][-1][1])]).T
    columns = {name: level if name == experiment.signal else np.full(level.size, moves[name][0][1]) for name in moves}
    write_table(path, Record(time_min, columns, path.name))


def diagnosis_jobs(
    files: Sequence[Path], out: Path | None, asked: DiagnosisOptions, *, elsewhere: bool
) -> list[Job[DiagnosisOptions]]:
    """Make a job for each file."""
    describes_itself = asked.process.is_default and not all(map(is_table, files))
    if not describes_itself and (len(files) > 1 or elsewhere):
        _check(asked)
    return make_jobs(files, asked, _folders(files, out), elsewhere=elsewhere)


def check_out(files: Sequence[Path], out: Path | None, model: Path | None, *, force: bool) -> None:
    """Check that the reports may be written."""
    if out is None:
        return
    sources = (*files, model)
    check_output_folder(out, SUMMARY if len(files) > 1 else (), sources, force=force)
    for folder in _folders(files, out):
        assert folder is not None
        check_output_folder(folder, REPORT, sources, force=force)


def run_job(job: Job[DiagnosisOptions]) -> JobResult:
    """Diagnose a file, and write its report if there is a folder for it."""
    case, not_written = load_case(job.at, job.asked)._replace(file=str(job.file)), ""
    found = diagnose_case(case, job.asked.tolerance, job.asked.limits)
    if job.folder is not None:
        report_stage("writing the report")
        try:
            write_report(found, job.file, job.folder, job.asked)
        except InputError as error:
            not_written = str(error)
    text = json_line(found.result.to_dict()) if job.asked.as_json else _text(job, found, has_report=not not_written)
    return JobResult(text, _row(found.result) | {"error": not_written or None}, not_written=not_written)


def _check(asked: DiagnosisOptions) -> None:
    process = asked.process.load()
    model = process.require_model(UnfitRecordError)
    process.select_causes(asked.without)
    if asked.uncertain is not None:
        parse_priors(asked.uncertain, model)
    check_limits(model, asked.limits)
    check_tolerance(model, asked.tolerance)


def _text(job: Job[DiagnosisOptions], found: DiagnosisResult, *, has_report: bool) -> str:
    text = diagnosis_text(found.result, found.effects)
    if job.folder is None or not has_report:
        return text
    if found.experiment is not None:
        text += f"\n  input       {job.folder / EXPERIMENT}"
    return f"{text}\n  report      {job.folder / PAGE}"


_COLUMNS = (
    *("samples", "span_min", "seconds", "verdict", "causes", "location", "significant", "practical", "delta_bic"),
    *("share", "probability"),  # of the causes
)


def _row(found: Diagnosis) -> Row:
    row = found.to_dict()
    first = row["causes"][0] if row["causes"] else {}
    row |= {"delta_bic": row["gain"]["delta_bic"], "share": first.get("share"), "probability": first.get("probability")}
    row |= {"causes": " + ".join(map(_fault_text, found.causes))}
    return {"file": found.file, "watched": True} | {name: row[name] for name in _COLUMNS}


def _fault_text(cause: Cause) -> str:
    """Format a cause as a fault: `coolant_flow:step:-0.0497@312min`."""
    size, onset = cause.parameters["size"], cause.parameters.get("onset")
    begin = "" if onset is None else f"@{onset.value:.4g}min"
    return f"{cause.cause}:{cause.profile}:{size.value:.3g}{begin}"


def _folders(files: Sequence[Path], out: Path | None) -> list[Path | None]:
    """Folders of the reports, one for each file; those of several files are named after them."""
    if out is None or len(files) == 1:
        return [out] * len(files)
    names: dict[str, int] = {}
    for file in files:
        stem, number = file.absolute().stem, 1
        name = stem
        while name in names:
            number = max(number, names[stem]) + 1
            name = f"{stem}-{number}"
        names[name] = 1
        names[stem] = max(names[stem], number)
    return [out / name for name in names]


def _summary(rows: Sequence[Row]) -> str:
    """Summary table: a line for each file, and the count of each verdict."""
    lines = [
        {
            "file": row["file"],
            "verdict": row["verdict"] or ("failed" if row["watched"] is None else "not diagnosed"),
            "causes": row["causes"] or "",
            "matters": "yes" if row["practical"] else "",
            "removes": "" if row["share"] is None else percent(row["share"]),
            "likely": "" if row["probability"] is None else percent(row["probability"]),
            "location": row["location"] or "",
        }
        for row in rows
    ]
    verdicts = [line["verdict"] for line in lines]
    counts = ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in sorted(set(verdicts)))
    return f"{as_table(lines)}\n\n{len(rows)} files: {counts}"


DIAGNOSING = JobKind("diagnosing", run_job, _COLUMNS, _summary)


def write_drawing(diagnosis: Diagnosis, model: ProcessModel, measured: Record, path: Path) -> None:
    """Write a Rerun file."""
    from recorder.view.file import DIAGNOSIS, write_views

    curves = diagnosis.curves
    assert curves is not None
    time_ns = np.array([to_time_ns(minutes, measured.zero_ns) for minutes in curves.time_min.tolist()], dtype=np.int64)
    write_views({DIAGNOSIS: [*_plots(diagnosis, curves, model, time_ns)]}, path, int(time_ns[0]))


def _plots(diagnosis: Diagnosis, curves: Curves, model: ProcessModel, time_ns: NDArray[np.int64]) -> Iterator[TimePlot]:
    """Outputs, their residuals, sizes of the causes, and inputs."""

    def line(label: str, values: Array, colour: Colour, legend: str = "", width: float = 1.0) -> Series:
        return Series(label, time_ns, values, colour, width=width, legend=legend)

    more = "extended" if diagnosis.is_extended or not diagnosis.with_nuisance else "with small corrections"
    for item in model.outputs:
        measured = line("measured", curves.measured[item.name], MEASURED, width=2.5)
        before = line("simulation as it was", curves.simulated_before[item.name], ALARM)
        after = line(f"simulation {more}", curves.simulated_after[item.name], PREDICTED)
        yield TimePlot(item.name, item.unit, (measured, before, after))
    ends = np.full(time_ns.size, SD_95)
    for item in model.outputs:
        limits = (
            line(f"{end} limit", sign * ends, LIMIT, "95 % of noise") for end, sign in (("upper", 1), ("lower", -1))
        )
        before = line("as it was", curves.residual_before[item.name], ALARM)
        after = line(more, curves.residual_after[item.name], PREDICTED)
        yield TimePlot(f"Residual of {item.name}", "standard deviations", (*limits, before, after))
    for cause in diagnosis.causes:
        lower, upper = interval(cause, curves)
        series = (
            line("upper end", upper, LIMIT, "95 % interval"),
            line("lower end", lower, LIMIT, "95 % interval"),
            Series("most likely", time_ns, curves.deviation[cause.cause], PREDICTED),
        )
        unit = cause.parameters["size"].unit
        yield TimePlot(f"Size of: {cause.label}", unit if unit != "1" else "", series)
    for given in model.inputs:
        held = Series(given.name, time_ns, curves.inputs[given.name], INPUT, held=True)
        yield TimePlot(f"{given.meaning} {given.name}", given.unit, (held,))


def write_extended_model(path: Path, written: dict[str, Any]) -> None:
    """Write the object from `ExtendedModel.to_object`; the file appears complete or not at all.

    Raises:
        InputError: the folder does not exist or cannot be written to.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")
