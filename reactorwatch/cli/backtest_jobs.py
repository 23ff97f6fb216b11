"""`backtest`: the monitor's core over each file, a job of its own; and of several files a summary."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.replay.backtest import run
from reactorwatch.cli.batch import Answer, Kind, Row, as_table
from reactorwatch.cli.options import existing_recording
from reactorwatch.cli.read_record import plant_of, tape
from reactorwatch.cli.reports import backtest_object, backtest_text
from reactorwatch.cli.unit_remarks import FirstSamples
from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.runtime.model_file import read_model_on_bus_clock


@dataclass(frozen=True)
class Job:
    """A file to be watched.

    Attributes:
        file: as it was named.
        at: where it is.
        settings: of the monitor, but for the plant, which the file may name.
        plant: in it; None: the only one there.
        columns: their names by signal.
        as_json: whether it is to be said to a machine.
        among: whether there are other files, so that what is said has to name this one.
    """

    file: Path
    at: Path
    settings: MonitorConfig
    plant: str | None
    columns: dict[str, str]
    as_json: bool
    among: bool


def jobs_of(
    files: Sequence[Path],
    settings: MonitorConfig,
    plant: str | None,
    columns: dict[str, str],
    *,
    as_json: bool,
    elsewhere: bool,
) -> list[Job]:
    """A job for each file.

    Args:
        files: .csv, .mcap, or folders of recordings.
        settings: of the monitor.
        plant: in recordings; None: the only one there.
        columns: their names by signal.
        as_json: whether it is to be said to a machine.
        elsewhere: whether the jobs are done by who sees the same files, but from another folder.
    """
    if elsewhere and settings.model is not None:
        settings = msgspec.structs.replace(settings, model=str(Path(settings.model).absolute()))
    return [
        Job(file, file.absolute() if elsewhere else file, settings, plant, columns, as_json, len(files) > 1)
        for file in files
    ]


def answer(job: Job) -> Answer:
    """Run the monitor over a file.

    Raises:
        InputError: the file cannot be read or has no value of any output, or settings do not fit together.
    """
    plant = plant_of(existing_recording(job.at), job.plant)
    settings = msgspec.structs.replace(job.settings, plant=plant)
    recording, first = tape(job.at, plant, job.columns, _units(settings)), FirstSamples(plant)
    result = run(first.pass_on(recording.messages), settings, recording.zero_ns or 0)
    if not result.rows:
        why = ", ".join(f"{count} {reason}" for reason, count in sorted(result.refused.items()))
        raise InputError(f"{job.at}: holds no sample that can be used{f'; refused: {why}' if why else ''}")
    if set(settings.outputs) <= result.left_out.keys():
        reasons = "; ".join(f"{name}: {result.left_out[name]}" for name in settings.outputs)
        raise InputError(f"{job.at}: there is no output to watch ({reasons})")
    zero_ns = result.first_ns if recording.zero_ns is None else recording.zero_ns
    found = backtest_object(result, zero_ns, recording.zero(result.first_ns))
    if job.as_json:
        said = msgspec.json.encode({"file": str(job.file), **found} if job.among else found).decode()
    else:
        said = backtest_text(result, zero_ns, job.file)
    return Answer(
        said, _row(job.file, found), remark=first.unit_remark(read_model_on_bus_clock(settings.model) or cstr())
    )


def _units(settings: MonitorConfig) -> dict[str, str] | None:
    """The units of the signals, if the settings say of which process they are; None: they do not."""
    model = read_model_on_bus_clock(settings.model)
    if model is None and settings.reference == "process":
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


def _failed(file: Path, reason: str) -> Row:
    return {"file": str(file), **dict.fromkeys((*_COLUMNS, *_OF_ALARMS)), "error": reason}


def _summary(rows: Sequence[Row]) -> str:
    """A line for each file, and how many there are with alarms and without."""
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


WATCHING = Kind("watching", answer, _failed, _summary)
