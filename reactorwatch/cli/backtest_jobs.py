"""`backtest`: one job for each file: run the monitor's core over it; and a summary of several files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.replay.backtest import run
from reactorwatch.cli.batch import JobKind, JobResult, Row, as_table
from reactorwatch.cli.options import check_recording
from reactorwatch.cli.read_record import open_messages, resolve_plant
from reactorwatch.cli.reports import backtest_object, backtest_text
from reactorwatch.cli.unit_remarks import FirstSamples
from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.runtime.model_file import read_model_on_bus_clock


@dataclass(frozen=True)
class Job:
    """A file to be monitored.

    Attributes:
        file: the file as named.
        at: path of the file for the worker.
        settings: settings of the monitor, except the plant, which the file may name.
        plant: plant in the file; None: the only one.
        columns: names of columns by signal.
        as_json: format the result as JSON.
        among: name the file in the result, because there are others.
        stated: statements about the form of a table.
    """

    file: Path
    at: Path
    settings: MonitorConfig
    plant: str | None
    columns: dict[str, str]
    as_json: bool
    among: bool
    stated: FileFormat = GUESS


def make_jobs(
    files: Sequence[Path],
    settings: MonitorConfig,
    plant: str | None,
    columns: dict[str, str],
    *,
    as_json: bool,
    elsewhere: bool,
    stated: FileFormat = GUESS,
) -> list[Job]:
    """Make a job for each file.

    Args:
        files: .csv, .mcap, or folders of recordings.
        settings: settings of the monitor.
        plant: plant in recordings; None: the only one.
        columns: names of columns by signal.
        as_json: format the results as JSON.
        elsewhere: use absolute paths, for workers with another working folder.
        stated: statements about the form of tables.
    """
    if elsewhere and settings.model is not None:
        settings = msgspec.structs.replace(settings, model=str(Path(settings.model).absolute()))
    return [
        Job(file, file.absolute() if elsewhere else file, settings, plant, columns, as_json, len(files) > 1, stated)
        for file in files
    ]


def run_job(job: Job) -> JobResult:
    """Run the monitor over a file.

    Raises:
        InputError: the file cannot be read or has no value of any output, or settings do not fit together.
    """
    plant = resolve_plant(check_recording(job.at), job.plant)
    settings = msgspec.structs.replace(job.settings, plant=plant)
    recording, first = open_messages(job.at, plant, job.columns, _units(settings), job.stated), FirstSamples(plant)
    result = run(first.collect_samples(recording.messages), settings, recording.zero_ns or 0)
    if not result.rows:
        why = ", ".join(f"{count} {reason}" for reason, count in sorted(result.refused.items()))
        raise InputError(f"{job.at}: holds no sample that can be used{f'; refused: {why}' if why else ''}")
    if set(settings.outputs) <= result.left_out.keys():
        reasons = "; ".join(f"{name}: {result.left_out[name]}" for name in settings.outputs)
        raise InputError(f"{job.at}: there is no output to watch ({reasons})")
    zero_ns = result.first_ns if recording.zero_ns is None else recording.zero_ns
    found = backtest_object(result, zero_ns, recording.zero(result.first_ns))
    if job.as_json:
        text = msgspec.json.encode({"file": str(job.file), **found} if job.among else found).decode()
    else:
        text = backtest_text(result, zero_ns, job.file)
    remarks = [f"read as: {recording.read_as}"] if recording.read_as else []
    remarks += filter(None, [first.unit_remark(read_model_on_bus_clock(settings.model) or cstr())])
    return JobResult(text, _row(job.file, found), remark="; ".join(remarks))


def _units(settings: MonitorConfig) -> dict[str, str] | None:
    """Units of the signals; None if the settings name no process."""
    model = read_model_on_bus_clock(settings.model)
    if model is None and settings.reference == "equations":
        model = cstr()
    return None if model is None else model.units


_COLUMNS = ("samples", "span_min", "trained_until_min", "expected_false_alarms")
_OF_ALARMS = ("alarms", "first_alarm", "first_alarm_min", "suspect")


def _row(file: Path, found: dict[str, Any]) -> Row:
    alarms = found["alarms"]
    suspects = [item["suspect"][0]["cause"] for item in alarms if item["suspect"]]
    first = alarms[0] if alarms else {"alarm": None, "raised_min": None}
    of_alarms = (len(alarms), first["alarm"], first["raised_min"], suspects[0] if suspects else None)
    return {
        "file": str(file),
        **{name: found[name] for name in _COLUMNS},
        **dict(zip(_OF_ALARMS, of_alarms, strict=True)),
        "error": None,
    }


def _summary(rows: Sequence[Row]) -> str:
    """Summary table: a line for each file, and the counts of files with and without alarms."""
    lines = [
        {
            "file": row["file"],
            "alarms": "failed" if row["error"] else str(row["alarms"]),
            "first": row["first_alarm"] or "",
            "at": "" if row["first_alarm_min"] is None else f"{row['first_alarm_min']:g} min",
            "suspect": row["suspect"] or "",
        }
        for row in rows
    ]
    failed = sum(bool(row["error"]) for row in rows)
    alarmed = sum(bool(row["alarms"]) for row in rows)
    counts = f"{alarmed} with alarms, {len(rows) - failed - alarmed} without, {failed} failed"
    return f"{as_table(lines)}\n\n{len(rows)} files: {counts}"


BACKTEST = JobKind("watching", run_job, (*_COLUMNS, *_OF_ALARMS), _summary)
