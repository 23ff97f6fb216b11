"""`diagnose`: one job for each file: read, diagnose, write the report; and a summary of several files.

Errors in the options, not in a file, are raised before the first job.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from reactorwatch.api.diagnosis import DiagnosisResult, diagnose_case
from reactorwatch.cli.batch import SUMMARY, Job, JobKind, JobResult, Row, as_table, make_jobs
from reactorwatch.cli.diagnosis import EXPERIMENT, PAGE, REPORT, DiagnosisOptions, load_case, write_report
from reactorwatch.cli.printing import json_line
from reactorwatch.diagnosis.experiment.constraints import check_limits
from reactorwatch.diagnosis.parameter_priors import parse_priors
from reactorwatch.diagnosis.practical_significance import check_tolerance
from reactorwatch.diagnosis.report.machine import as_object
from reactorwatch.diagnosis.report.plain import as_text
from reactorwatch.diagnosis.result import Cause
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.records.decode import is_table
from reactorwatch.records.write import check_output_folder


def diagnosis_jobs(
    files: Sequence[Path], out: Path | None, asked: DiagnosisOptions, *, elsewhere: bool
) -> list[Job[DiagnosisOptions]]:
    """Make a job for each file.

    Args:
        files: .csv, .mcap, or folders of recordings.
        out: folder for the report; each of several files gets a folder in it.
        asked: options of the diagnosis.
        elsewhere: see `make_jobs`.

    Raises:
        InputError: invalid options.
    """
    describes_itself = asked.process.is_default and not all(map(is_table, files))
    if not describes_itself and (len(files) > 1 or elsewhere):
        _check(asked)
    return make_jobs(files, asked, _folders(files, out), elsewhere=elsewhere)


def check_out(files: Sequence[Path], out: Path | None, model: Path | None, *, force: bool) -> None:
    """Check that the reports may be written.

    Args:
        files: files to be diagnosed.
        out: see `diagnosis_jobs`.
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


def run_job(job: Job[DiagnosisOptions]) -> JobResult:
    """Diagnose a file, and write its report if there is a folder for it.

    Raises:
        InputError: the file cannot be read or diagnosed, or the options are invalid.
    """
    found = diagnose_case(load_case(job.at, job.asked), job.asked.tolerance, job.asked.limits)
    not_written, report = "", as_object(found, str(job.file), found.seconds, found.zero)
    if job.folder is not None:
        try:
            write_report(found, job.file, job.folder, job.asked)
        except InputError as error:
            not_written = str(error)
    text = json_line(report) if job.asked.as_json else _text(job, found, has_report=not not_written)
    return JobResult(text, _row(report, found) | {"error": not_written or None}, not_written=not_written)


def _check(asked: DiagnosisOptions) -> None:
    process = asked.process.load()
    model = process.require_model(UnfitRecordError)
    process.select_causes(asked.without)
    if asked.uncertain is not None:
        parse_priors(asked.uncertain, model)
    check_limits(model, asked.limits)
    check_tolerance(model, asked.tolerance)


def _text(job: Job[DiagnosisOptions], found: DiagnosisResult, *, has_report: bool) -> str:
    text = as_text(found, str(job.file), found.effects)
    if job.folder is None or not has_report:
        return text
    if found.experiment is not None:
        text += f"\n  input       {job.folder / EXPERIMENT}"
    return f"{text}\n  report      {job.folder / PAGE}"


_COLUMNS = ("samples", "span_min", "seconds", "verdict", "causes", "location", "significant", "practical", "delta_bic")


def _row(report: dict[str, Any], found: DiagnosisResult) -> Row:
    row = report | {"causes": " + ".join(map(_fault_text, found.causes)), "delta_bic": report["gain"]["delta_bic"]}
    return {"file": row["file"], "watched": True} | {name: row[name] for name in _COLUMNS}


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
            "delta BIC": "" if row["delta_bic"] is None else f"{row['delta_bic']:,.0f}",
            "location": row["location"] or "",
        }
        for row in rows
    ]
    verdicts = [line["verdict"] for line in lines]
    counts = ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in sorted(set(verdicts)))
    return f"{as_table(lines)}\n\n{len(rows)} files: {counts}"


DIAGNOSIS = JobKind("diagnosing", run_job, _COLUMNS, _summary)
