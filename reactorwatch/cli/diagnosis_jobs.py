"""`diagnose`: each file is a job of its own, read, diagnosed, and its report written; and all of them a summary.

What is wrong with the options, and not with a file, is told before the first.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from reactorwatch.cli.batch import SUMMARY, Answer, Kind, Row, as_table
from reactorwatch.cli.diagnosis import EXPERIMENT, PAGE, REPORT, Asked, Case, case_of, diagnosed, write_report
from reactorwatch.diagnosis.experiment.constraints import check_limits
from reactorwatch.diagnosis.parameter_priors import parse_priors
from reactorwatch.diagnosis.practical_significance import check_tolerance
from reactorwatch.diagnosis.report.machine import as_object
from reactorwatch.diagnosis.report.plain import as_text
from reactorwatch.diagnosis.result import Cause, Diagnosis
from reactorwatch.errors import InputError
from reactorwatch.process import effects_of
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.records.output import checked_folder
from reactorwatch.runtime.model_file import read_extended_model


@dataclass(frozen=True)
class Job:
    """A file to be diagnosed.

    Attributes:
        file: as it was named.
        at: where it is.
        folder: for the report; None: none is wanted.
        asked: about it.
        as_json: whether it is to be said to a machine.
    """

    file: Path
    at: Path
    folder: Path | None
    asked: Asked
    as_json: bool


def jobs_of(files: Sequence[Path], out: Path | None, asked: Asked, *, as_json: bool, elsewhere: bool) -> list[Job]:
    """A job for each file.

    Args:
        files: .csv, .mcap, or folders of recordings.
        out: folder for the report; of several files, each gets a folder in it.
        asked: about all of them.
        as_json: whether it is to be said to a machine.
        elsewhere: whether the jobs are done by who sees the same files, but from another folder.

    Raises:
        InputError: what is asked cannot be meant, of whatever file.
    """
    if len(files) > 1 or elsewhere:
        _check(asked)
    places = list(files)
    if elsewhere:
        places, out = [file.absolute() for file in files], out and out.absolute()
        asked = replace(asked, model=asked.model and asked.model.absolute())
    folders = _folders(files, out)
    return [Job(*item, asked, as_json) for item in zip(files, places, folders, strict=True)]


def check_out(files: Sequence[Path], out: Path | None, model: Path | None, *, force: bool) -> None:
    """Check that the reports may be written.

    Args:
        files: that are diagnosed.
        out: as for `jobs_of`.
        model: file of an extended model, or None.
        force: as for `checked_output`.

    Raises:
        InputError: as `checked_folder`.
    """
    if out is None:
        return
    sources = (*files, model)
    checked_folder(out, SUMMARY if len(files) > 1 else (), sources, force=force)
    for folder in _folders(files, out):
        assert folder is not None
        checked_folder(folder, REPORT, sources, force=force)


def answer(job: Job) -> Answer:
    """Diagnose a file, and write its report if there is a folder for it; the answer says where that failed.

    Raises:
        InputError: the file cannot be read or diagnosed, or what is asked cannot be meant.
    """
    case = case_of(job.file, job.folder, job.asked, job.at)
    diagnosis, seconds = diagnosed(case, job.asked.tolerance, job.asked.limits)
    not_written = ""
    if case.folder is not None:
        try:
            write_report(diagnosis, case, seconds)
        except InputError as error:
            case, not_written = replace(case, folder=None), str(error)
    said = _said(case, diagnosis, seconds, as_json=job.as_json)
    return Answer(said, _row(job.file, diagnosis, seconds) | {"error": not_written or None}, not_written=not_written)


def _check(asked: Asked) -> None:
    model = cstr() if asked.model is None else read_extended_model(asked.model).build()
    if asked.uncertain is not None:
        parse_priors(asked.uncertain, model)
    check_limits(model, asked.limits)
    check_tolerance(model, asked.tolerance)


def _said(case: Case, diagnosis: Diagnosis, seconds: float, *, as_json: bool) -> str:
    if as_json:
        return msgspec.json.encode(as_object(diagnosis, str(case.file), seconds, case.measured.zero)).decode()
    said = as_text(diagnosis, str(case.file), effects_of(case.model))
    if case.folder is None:
        return said
    if diagnosis.experiment is not None:
        said += f"\n  input       {case.folder / EXPERIMENT}"
    return f"{said}\n  report      {case.folder / PAGE}"


_COLUMNS = ("samples", "span_min", "seconds", "verdict", "causes", "location", "significant", "practical", "delta_bic")


def _row(file: Path, diagnosis: Diagnosis, seconds: float) -> Row:
    said = as_object(diagnosis, str(file), seconds)
    said |= {"causes": " + ".join(map(_written, diagnosis.causes)), "delta_bic": said["gain"]["delta_bic"]}
    return {"file": str(file), **{name: said[name] for name in _COLUMNS}, "error": None}


def _failed(file: Path, reason: str) -> Row:
    return {"file": str(file), **dict.fromkeys(_COLUMNS), "error": reason}


def _written(cause: Cause) -> str:
    """As a fault is written: `coolant_flow:step:-0.0497@312min`."""
    size, onset = cause.parameters["size"], cause.parameters.get("onset")
    begin = "" if onset is None else f"@{onset.value:.4g}min"
    return f"{cause.cause}:{cause.profile}:{size.value:.3g}{begin}"


def _folders(files: Sequence[Path], out: Path | None) -> list[Path | None]:
    """One for each file: named after it, if there are several."""
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
    """The summary for people: a line for each file, and how many there are of each verdict."""
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


DIAGNOSING = Kind("diagnosing", answer, _failed, _summary)
