"""`diagnose`: one job for each file: read, diagnose, write the report; and a summary of several files.

Errors in the options, not in a file, are raised before the first job.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from reactorwatch.cli.batch import SUMMARY, JobKind, JobResult, Row, as_table
from reactorwatch.cli.diagnosis import (
    EXPERIMENT,
    PAGE,
    REPORT,
    Case,
    DiagnosisOptions,
    load_case,
    run_diagnosis,
    write_report,
)
from reactorwatch.diagnosis.experiment.constraints import check_limits
from reactorwatch.diagnosis.parameter_priors import parse_priors
from reactorwatch.diagnosis.practical_significance import check_tolerance
from reactorwatch.diagnosis.report.machine import as_object
from reactorwatch.diagnosis.report.plain import as_text
from reactorwatch.diagnosis.result import Cause, Diagnosis
from reactorwatch.errors import InputError
from reactorwatch.records.output import check_output_folder
from reactorwatch.records.source_text import is_table


@dataclass(frozen=True)
class Job:
    """A file to be diagnosed.

    Attributes:
        file: the file as named.
        at: path of the file for the worker.
        folder: folder for the report; None: no report.
        asked: options of the diagnosis.
        as_json: format the result as JSON.
    """

    file: Path
    at: Path
    folder: Path | None
    asked: DiagnosisOptions
    as_json: bool


def make_jobs(
    files: Sequence[Path], out: Path | None, asked: DiagnosisOptions, *, as_json: bool, elsewhere: bool
) -> list[Job]:
    """Make a job for each file.

    Args:
        files: .csv, .mcap, or folders of recordings.
        out: folder for the report; each of several files gets a folder in it.
        asked: options of the diagnosis.
        as_json: format the results as JSON.
        elsewhere: use absolute paths, for workers with another working folder.

    Raises:
        InputError: invalid options.
    """
    describes_itself = asked.process.is_default and not all(map(is_table, files))
    if not describes_itself and (len(files) > 1 or elsewhere):
        _check(asked)
    paths = list(files)
    if elsewhere:
        paths, out = [file.absolute() for file in files], out and out.absolute()
        asked = replace(asked, process=asked.process.absolute())
    folders = _folders(files, out)
    return [Job(*item, asked, as_json) for item in zip(files, paths, folders, strict=True)]


def check_out(files: Sequence[Path], out: Path | None, model: Path | None, *, force: bool) -> None:
    """Check that the reports may be written.

    Args:
        files: files to be diagnosed.
        out: see `make_jobs`.
        model: file that describes the process, or None.
        force: see `check_output_file`.

    Raises:
        InputError: as `check_output_folder`.
    """
    if out is None:
        return
    sources = (*files, model)
    check_output_folder(out, SUMMARY if len(files) > 1 else (), sources, force=force)
    for folder in _folders(files, out):
        assert folder is not None
        check_output_folder(folder, REPORT, sources, force=force)


def run_job(job: Job) -> JobResult:
    """Diagnose a file, and write its report if there is a folder for it.

    Raises:
        InputError: the file cannot be read or diagnosed, or the options are invalid.
    """
    case = load_case(job.file, job.folder, job.asked, job.at)
    diagnosis, seconds = run_diagnosis(case, job.asked.tolerance, job.asked.limits)
    not_written = ""
    if case.folder is not None:
        try:
            write_report(diagnosis, case, seconds)
        except InputError as error:
            case, not_written = replace(case, folder=None), str(error)
    text = _text(case, diagnosis, seconds, as_json=job.as_json)
    return JobResult(text, _row(job.file, diagnosis, seconds) | {"error": not_written or None}, not_written=not_written)


def _check(asked: DiagnosisOptions) -> None:
    process = asked.process.load()
    model = process.require_model()
    process.select_causes(asked.without)
    if asked.uncertain is not None:
        parse_priors(asked.uncertain, model)
    check_limits(model, asked.limits)
    check_tolerance(model, asked.tolerance)


def _text(case: Case, diagnosis: Diagnosis, seconds: float, *, as_json: bool) -> str:
    if as_json:
        return msgspec.json.encode(as_object(diagnosis, str(case.file), seconds, case.measured.zero)).decode()
    text = as_text(diagnosis, str(case.file), case.effects)
    if case.folder is None:
        return text
    if diagnosis.experiment is not None:
        text += f"\n  input       {case.folder / EXPERIMENT}"
    return f"{text}\n  report      {case.folder / PAGE}"


_COLUMNS = ("samples", "span_min", "seconds", "verdict", "causes", "location", "significant", "practical", "delta_bic")


def _row(file: Path, diagnosis: Diagnosis, seconds: float) -> Row:
    report = as_object(diagnosis, str(file), seconds)
    report |= {"causes": " + ".join(map(_fault_text, diagnosis.causes)), "delta_bic": report["gain"]["delta_bic"]}
    return {"file": str(file), **{name: report[name] for name in _COLUMNS}, "error": None}


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
            "verdict": row["verdict"] or "failed",
            "causes": row["causes"] or "",
            "matters": "yes" if row["practical"] else "",
            "delta BIC": "" if row["delta_bic"] is None else f"{row['delta_bic']:,.0f}",
            "location": row["location"] or "",
        }
        for row in rows
    ]
    verdicts = [line["verdict"] for line in lines]
    counts = ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in sorted(set(verdicts)))
    return f"{as_table(lines)}\n\n{len(rows)} files: {counts}"


DIAGNOSIS = JobKind("diagnosing", run_job, _COLUMNS, _summary)
