"""`backtest`: one job for each file: run the monitor's core over it; and a summary of several files."""

import csv
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from monitor_node.config import DEFAULT, DEFAULT_TRAINING_ROWS, MonitorConfig
from monitor_node.replay.backtest import Backtest, TrainedPlant, run, train
from monitor_node.replay.record_checks import check_training_record
from monitor_node.replay.report_watch import watch
from monitor_node.replay.row_log import LoggedRow, RowLog, rows_of_file
from monitor_node.watched_process import WatchedProcess, limit_training, load_process, watch_process
from reactorwatch.api.backtest_report import backtest_object, backtest_text
from reactorwatch.api.files import MessageSource, open_messages, record, resolve_plant
from reactorwatch.cli.batch import FileOptions, Job, JobKind, JobResult, Row, as_table
from reactorwatch.cli.options import check_recording
from reactorwatch.cli.printing import json_line
from reactorwatch.cli.unit_remarks import FirstSamples
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded
from reactorwatch.description.choice import ProcessChoice
from reactorwatch.description.find import DEFAULT_PROCESS
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.record import to_minutes, to_time_ns

ROWS_FOR_TRAINING = 3 * DEFAULT_TRAINING_ROWS
"""Rows that are counted to find a third of a record; of a longer one the training is not limited."""

SCHEMES = MONITOR_SCHEME, REPORT_SCHEME = ("monitor", "report")

LOG_COLUMNS = ("file", "row", "time_min", "in_alarm", "raised")


@dataclass(frozen=True, kw_only=True)
class BacktestOptions(FileOptions):
    """Options of a back-test.

    Attributes:
        settings: settings of the monitor, except the plant, which the file may name.
        log_rows: return the rows with their alarms.
        scheme: `monitor`, or `report` for the scheme of the original report.
        is_one_of_many: name the file in the result, because there are others.
        trained: result of a training on another file; None: each file begins with a training.
    """

    settings: MonitorConfig
    log_rows: bool = False
    scheme: str = MONITOR_SCHEME
    is_one_of_many: bool = False
    trained: TrainedPlant | None = None

    def __post_init__(self) -> None:
        if self.scheme not in SCHEMES:
            raise InputError(f"--scheme: {describe_unknown('scheme', self.scheme, SCHEMES)}")


class RowsOfFile(NamedTuple):
    """The rows of a file with their alarms.

    Attributes:
        file: the file as named.
        rows: the rows.
        zero_ns: time from which their minutes are counted.
    """

    file: Path
    rows: list[LoggedRow]
    zero_ns: int


class _Opened(NamedTuple):
    """A file that is open, and the settings to watch it by.

    Attributes:
        source: messages of the file.
        watched: settings and equations.
        process: process that was named, recorded or described by its columns; None: as the settings say.
        still: inputs that never move, with the reason why they explain nothing.
    """

    source: MessageSource
    watched: WatchedProcess
    process: Process | None
    still: dict[str, str]


def choose_settings(settings: MonitorConfig, choice: ProcessChoice) -> ProcessChoice:
    """Choice of a process with that of the settings, where no other is named.

    Signals in the settings that are none of the default process's describe a process without equations.
    """
    if not choice.is_default:
        return choice
    if settings.process is not None or settings.is_default_process:
        needs_default = settings.reference == "equations"
        return ProcessChoice(settings.process or (DEFAULT_PROCESS if needs_default else None))
    return ProcessChoice(None, settings.inputs, settings.outputs)


def train_on(file: Path, asked: BacktestOptions) -> TrainedPlant:
    """Train on the whole of a file.

    Raises:
        InputError: as `run_job`; or the file has too few rows, or no output that can be watched.
    """
    opened = _open(file, asked, learns=True)
    try:
        config, model = opened.watched
        return train(opened.source.messages, config, opened.source.zero_ns or 0, model)
    except InputError as error:
        raise InputError(f"--train {file}: {error}") from error


def run_job(job: Job[BacktestOptions]) -> JobResult:
    """Run the monitor over a file.

    Raises:
        InputError: the file cannot be read or has no value of any output, or settings do not fit together.
    """
    asked = job.asked
    opened = _open(job.at, asked, learns=asked.trained is None)
    source, (config, model) = opened.source, opened.watched
    first, log = FirstSamples(config.plant), RowLog() if asked.log_rows else None
    if asked.scheme == REPORT_SCHEME:
        result = _watch_by_report(job, opened, log)
    else:
        result = run(first.collect_samples(source.messages), config, source.zero_ns or 0, model, asked.trained, log)
    result.left_out = opened.still | result.left_out
    _check_watched(job.at, result)
    zero_ns = result.first_ns if source.zero_ns is None else source.zero_ns
    zero = source.zero(result.first_ns)
    found = backtest_object(result, zero_ns, zero, is_trained=asked.trained is not None)
    if asked.as_json:
        text = json_line({"file": str(job.file), **found} if asked.is_one_of_many else found)
    else:
        text = backtest_text(result, zero_ns, job.file, zero_ns if zero else None, is_trained=asked.trained is not None)
    remarks = [f"read as: {source.read_as}"] if source.read_as else []
    if opened.process is None or model is not None:
        remarks += filter(None, [first.unit_remark(model or DEFAULT.require_model())])
    logged = None if log is None else RowsOfFile(job.file, _logged_rows(log, source, zero_ns), zero_ns)
    return JobResult(text, _row(job.file, found), remark="; ".join(remarks), extra=logged)


def _watch_by_report(job: Job[BacktestOptions], opened: _Opened, log: RowLog | None) -> Backtest:
    """Watch a file by the scheme of the original report."""
    config = opened.watched[0]
    measured = record(job.at, job.asked.plant, job.asked.columns, opened.process, job.asked.stated)
    if measured.runs is not None:
        raise InputError(f"{job.at}: the report's scheme needs one run, {measured.describe_runs()}; cut one out of it")
    length, minutes = config.training_length, measured.time_min
    rows = length.rows or int(np.searchsorted(minutes, minutes[0] + (length.minutes or 0.0) - 1e-9))
    return watch(measured, config.inputs, config.outputs, rows, measured.zero_ns, log)


def _check_watched(file: Path, result: Backtest) -> None:
    if not result.rows:
        why = ", ".join(f"{count} {reason}" for reason, count in sorted(result.refused.items()))
        raise InputError(f"{file}: holds no sample that can be used{f'; refused: {why}' if why else ''}")
    if set(result.outputs) <= result.left_out.keys():
        reasons = "; ".join(f"{name}: {result.left_out[name]}" for name in result.outputs)
        raise InputError(f"{file}: there is no output to watch ({reasons})")


def _open(file: Path, asked: BacktestOptions, *, learns: bool) -> _Opened:
    """Open a file, and find the settings to watch it by.

    Args:
        file: path of the file.
        asked: options of the back-test.
        learns: True if the monitor is trained on the file.

    Raises:
        InputError: the file or the process cannot be read, settings do not fit together, or the file is none to learn
            from.
    """
    plant = resolve_plant(check_recording(file), asked.plant)
    settings = msgspec.structs.replace(asked.settings, plant=plant)
    choice = choose_settings(settings, asked.process)
    source = open_messages(file, plant, asked.columns, asked.stated, choice, for_equations=True)
    rows, messages = _count_rows(source.messages, plant)
    source = source._replace(messages=messages)
    if choice.is_default:
        recorded = source.process if source.measured is None else None
        if recorded is None or recorded.name == DEFAULT.name:
            return _Opened(source, load_process(limit_training(settings, rows)), None, {})
        return _Opened(source, watch_process(settings, recorded, rows), recorded, {})
    process = choice.load(source.zero_ns or 0, on_bus=True)
    watched, still = watch_process(settings, process, rows), dict[str, str]()
    if source.measured is not None and learns:
        still = check_training_record(source.measured, *watched)
    return _Opened(source, watched, process, still)


def _count_rows(messages: Iterable[Encoded], plant: str) -> tuple[int, Iterator[Encoded]]:
    """Number of rows, at most `ROWS_FOR_TRAINING`, by the samples of the most frequent signal; and all messages."""
    prefix, counts = keys.key(plant, keys.SAMPLE, ""), dict[str, int]()
    messages, first = iter(messages), []
    for message in messages:
        first.append(message)
        if message.key.startswith(prefix):
            counts[message.key] = counts.get(message.key, 0) + 1
            if counts[message.key] >= ROWS_FOR_TRAINING:
                break
    return max(counts.values(), default=0), chain(first, messages)


def _logged_rows(log: RowLog, source: MessageSource, zero_ns: int) -> list[LoggedRow]:
    if source.measured is None:
        return log.rows
    return rows_of_file(log.rows, [to_time_ns(minutes, zero_ns) for minutes in source.measured.time_min.tolist()])


def write_rows(path: Path, files: Sequence[RowsOfFile]) -> None:
    """Write the rows of files with their alarms as a table.

    Raises:
        InputError: it cannot be written.
    """
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(LOG_COLUMNS)
        for file in files:
            for number, row in enumerate(file.rows):
                minutes = repr(to_minutes(row.time_ns, file.zero_ns))
                writer.writerow((str(file.file), number, minutes, int(row.in_alarm), int(row.raised)))


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
