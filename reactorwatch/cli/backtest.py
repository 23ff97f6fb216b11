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
from monitor_node.replay.backtest import (
    LoggedRow,
    RecordFacts,
    RowLog,
    TrainedPlant,
    check_training_record,
    check_watched,
    rows_of_file,
    run,
    train,
)
from monitor_node.watched_process import WatchedProcess, limit_training, load_process, watch_process
from reactorwatch.api.files import MessageSource, open_messages, resolve_plant
from reactorwatch.cli.batch import FileOptions, Job, JobKind, JobResult, Row, as_table, unit_remark
from reactorwatch.cli.display import json_line
from reactorwatch.cli.options import check_recording
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.messages_pb2 import Sample
from reactorwatch.description.process import Process
from reactorwatch.description.read import ProcessChoice
from reactorwatch.errors import prefix_errors
from reactorwatch.process import DEFAULT_PROCESS
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.decode import is_table, quote_formula
from reactorwatch.records.record import to_minutes, to_time_ns
from reactorwatch.records.write import atomic_write
from reactorwatch.results.backtest import Backtest
from reactorwatch.sentences.backtest import backtest_text
from reactorwatch.sentences.incidents import group_by_cause

ROWS_FOR_TRAINING = 3 * DEFAULT_TRAINING_ROWS
"""Rows that are counted to find a third of a record; of a longer one the training is not limited."""

LOG_COLUMNS = ("file", "row", "time_min", "in_alarm", "raised")


@dataclass(frozen=True, kw_only=True)
class BacktestOptions(FileOptions):
    """Options of a back-test."""

    settings: MonitorConfig  # but for the plant, which the file may name
    log_rows: bool = False
    is_one_of_many: bool = False  # it is then named in its result
    trained: TrainedPlant | None = None  # on another file; else each begins with a training


class RowsOfFile(NamedTuple):
    """The rows of a file with their alarms."""

    file: Path
    rows: list[LoggedRow]
    zero_ns: int  # from which their minutes are counted


class _Opened(NamedTuple):
    """A file that is open, and the settings to watch it by."""

    source: MessageSource
    watched: WatchedProcess
    process: Process | None  # named, recorded or described by its columns
    still: dict[str, str]  # inputs that never move, and why they explain nothing


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
    """Train on the whole of a file."""
    opened = _open(file, asked, learns=True)
    with prefix_errors(f"--train {file}"):
        config, model = opened.watched
        return train(opened.source.messages, config, opened.source.zero_ns or 0, model)


def run_job(job: Job[BacktestOptions]) -> JobResult:
    """Run the monitor over a file."""
    asked = job.asked
    opened = _open(job.at, asked, learns=asked.trained is None)
    source, (config, model) = opened.source, opened.watched
    first, log = FirstSamples(config.plant), RowLog() if asked.log_rows else None
    facts = RecordFacts(str(job.file), 0 if source.has_clock else None, opened.still)
    result = run(first.collect_samples(source.messages), config, source.zero_ns, model, asked.trained, log, facts)
    check_watched(job.at, config.outputs, result)
    if asked.as_json:
        text = json_line(result.to_dict("file") if asked.is_one_of_many else result.to_dict())
    else:
        text = backtest_text(result)
    remarks = [f"read as: {source.read_as}"] if source.read_as else []
    if opened.process is None or model is not None:
        remarks += filter(None, [first.remark(model or DEFAULT.require_model())])
    own_rows = source.measured is not None and config.resample is None
    logged = None if log is None else _logged_rows(log, source, result.zero_ns) if own_rows else log.rows
    rows = None if logged is None else RowsOfFile(job.file, logged, result.zero_ns)
    return JobResult(text, _row(result), remark="; ".join(remarks), not_watched=result.why or "", extra=rows)


def _open(file: Path, asked: BacktestOptions, *, learns: bool) -> _Opened:
    """Open a file, and find the settings to watch it by."""
    plant = resolve_plant(check_recording(file), asked.plant)
    settings = msgspec.structs.replace(asked.settings, plant=plant)
    choice = choose_settings(settings, asked.process)
    source = open_messages(file, plant, asked.columns, asked.stated, choice, for_equations=True)
    rows: int | None = None  # of resampled samples there are other rows
    if settings.resample is None:
        rows, messages = _count_rows(source.messages, plant)
        source = source._replace(messages=messages)
    if choice.is_default:
        recorded = None if is_table(file) else source.process
        if recorded is None:
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
    assert source.measured is not None
    return rows_of_file(log.rows, [to_time_ns(minutes, zero_ns) for minutes in source.measured.time_min.tolist()])


def write_rows(path: Path, files: Sequence[RowsOfFile]) -> None:
    """Write the rows of files with their alarms as a table."""
    with atomic_write(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as out:
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(LOG_COLUMNS)
        for file in files:
            for number, row in enumerate(file.rows):
                minutes = repr(to_minutes(row.time_ns, file.zero_ns))
                writer.writerow((quote_formula(str(file.file)), number, minutes, int(row.in_alarm), int(row.raised)))


_COLUMNS = ("samples", "span_min", "trained_until_min", "expected_false_alarms", "trustworthy")
_OF_ALARMS = ("alarms", "first_alarm", "first_alarm_min", "suspect")


def _row(result: Backtest) -> Row:
    """Row of a file; the first alarm and the suspect are those of the largest incident."""
    values = (
        *(result.samples, result.span_min, result.trained_until_min, result.expected_false_alarms),
        result.promise and result.promise.kept,
    )
    of_alarms: tuple[Any, ...] = (0, None, None, None)
    for largest, *_ in group_by_cause(result.alarms)[:1]:
        first = largest.raised[0]
        suspect = largest.suspect or next(iter(first.suspect), None)
        cause = None if suspect is None else suspect.cause
        of_alarms = (len(result.alarms), first.alarm, first.raised_min, cause)
    return {
        "file": result.file,
        "watched": result.watched,
        **dict(zip((*_COLUMNS, *_OF_ALARMS), (*values, *of_alarms), strict=True)),
        "error": result.why,
    }


def _summary(rows: Sequence[Row]) -> str:
    """Summary table: a line for each file, and the counts of files with and without alarms."""
    lines = [
        {
            "file": row["file"],
            "alarms": str(row["alarms"]) if row["watched"] else "failed" if row["watched"] is None else "not watched",
            "but": "not trustworthy yet" if row["watched"] and row["trustworthy"] is False else "",
            "first": row["first_alarm"] or "",
            "at": "" if row["first_alarm_min"] is None else f"{row['first_alarm_min']:g} min",
            "suspect": row["suspect"] or "",
        }
        for row in rows
    ]
    failed, unwatched = (sum(row["watched"] is state for row in rows) for state in (None, False))
    alarmed = sum(bool(row["watched"] and row["alarms"]) for row in rows)
    sound = len(rows) - failed - unwatched - alarmed
    counts = f"{alarmed} with alarms, {sound} without, {unwatched} not watched, {failed} failed"
    return f"{as_table(lines)}\n\n{len(rows)} files: {counts}"


BACKTEST = JobKind("watching", run_job, (*_COLUMNS, *_OF_ALARMS), _summary)
MAX_SAMPLES = 3000
"""Samples of each signal from which its unit is checked."""


class FirstSamples:
    """Collects the first samples of a plant from a stream of messages."""

    def __init__(self, plant: str) -> None:
        self._prefix = keys.key(plant, keys.SAMPLE, "")
        self._series: dict[str, list[tuple[int, float]]] = {}

    def collect_samples(self, messages: Iterable[Encoded]) -> Iterator[Encoded]:
        """Yield the messages unchanged, and collect the first samples."""
        for message in messages:
            if message.key.startswith(self._prefix):
                series = self._series.setdefault(message.key.removeprefix(self._prefix), [])
                if len(series) < MAX_SAMPLES:
                    self._collect(message, series)
            yield message

    def _collect(self, message: Encoded, series: list[tuple[int, float]]) -> None:
        try:
            sample = decode(message.payload, message.encoding)
        except DecodeError:
            return  # the monitor counts it as refused
        if isinstance(sample, Sample):
            series.append((sample.time_ns, sample.value))

    def remark(self, model: ProcessModel) -> str:
        """Remark on the units of these samples."""
        columns = {name: np.array([value for _, value in series]) for name, series in self._series.items()}
        times = next(iter(self._series.values()), [])
        return unit_remark(model, columns, np.array([to_minutes(time_ns) for time_ns, _ in times]))
