"""Read recordings from MCAP files: https://mcap.dev/spec. They are written by `mcap_writer`.

The topic of a message is its key, its log time the time of receipt, its publish time the sample time. Messages of this
software carry their protobuf schema, so that any program reads them. Other messages are recorded with the encoding
that they claimed and no schema.

The metadata record "reactorwatch" holds the version that wrote the file and details of its origin. Its `zero_ns` is the
time that minutes count from, where that is not the first sample. If its `clock` is `none`, the record had no clock
time, and its times were shifted so that none is before 1970.

A metadata record "reactorwatch.process" names the process of a plant, its signals with their units and roles, and its
equations.

A folder is read as one recording, file by file in the order of time, or interleaved where times overlap. Latched
messages are skipped in all files but the first.
"""

import heapq
from array import array
from collections.abc import Collection, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from reactorwatch.contract import keys
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError
from reactorwatch.records.input_file import list_files
from reactorwatch.records.record import MINUTE_NS, Record, join_runs
from recorder.columns.process_annotations import signal_roles
from recorder.columns.sample_series import BATCH, FIRST_BATCH, SAMPLE, SampleSeries
from recorder.message import RecordedMessage
from recorder.storage.mcap_chunks import (
    is_in_order,
    is_indexed,
    metadata_records,
    ordered_messages,
    read_summary,
    sorted_messages,
    span_ns,
)
from recorder.storage.mcap_scan import unindexed_messages
from recorder.storage.mcap_types import Summary
from recorder.storage.mcap_writer import RecordingWriter, own_metadata
from recorder.storage.process_metadata import processes_in
from recorder.tools.overlap import group_overlapping

__all__ = ["RecordingWriter", "plants_in", "read_messages", "read_metadata", "read_record", "recordings_in"]

ZERO_NS = "zero_ns"
CLOCK, NO_CLOCK = "clock", "none"


def read_messages(
    path: Path, kinds: Collection[str] | None = None, plant: str | None = None
) -> Iterator[RecordedMessage]:
    """Messages of a recording in the order of receipt; those of equal time in the order of the file.

    Args:
        path: file or folder of any size; one chunk of each file is in memory at a time.
        kinds: kinds to read, such as `keys.SAMPLE`; None for all, other programs' keys included.
        plant: plant to read; None for all.

    Raises:
        InputError: the file does not exist, is no MCAP file, or is damaged. Damage within a chunk is raised when the
            iteration reaches it.
    """
    groups = group_overlapping(
        _files(path), lambda file: file.span
    )  # not within a generator: errors are raised at the call

    def is_selected(key: str) -> bool:
        topic = keys.parse(key)
        if topic is None:
            return kinds is None and plant is None
        return (kinds is None or topic.kind in kinds) and (plant is None or topic.plant == plant)

    def read(file: _File) -> Iterator[RecordedMessage]:
        if is_indexed(file.summary) and is_in_order(file.summary):
            numbers = {number for number, channel in file.summary.channels.items() if is_selected(channel.topic)}
            found = ordered_messages(file.path, file.summary, numbers)
        else:
            found = (entry for entry in _all_messages(file) if is_selected(entry.key))
        return found if file.first else (entry for entry in found if not entry.latched)

    if len(groups) == len(groups[0]) == 1:
        return read(groups[0][0])
    return (entry for group in groups for entry in heapq.merge(*map(read, group), key=lambda entry: entry.log_time_ns))


def recordings_in(path: Path) -> list[Path]:
    """Files of a recording in the order of their times: the path itself, or the files in the folder.

    Raises:
        InputError: a file is damaged, or the folder holds none.
    """
    return [file.path for file in _files(path)]


def plants_in(path: Path) -> tuple[str, ...]:
    """Plants with samples in the recording, in alphabetical order.

    Raises:
        InputError: as `read_messages`.
    """
    return tuple(sorted({topic.plant for topic in sample_topics_in(path)}))


def sample_topics_in(path: Path) -> set[keys.Topic]:
    """Topics of the samples in the recording.

    Raises:
        InputError: as `read_messages`.
    """
    found: set[keys.Topic] = set()
    for file in _files(path):
        topics = {channel.topic for channel in file.summary.channels.values()}
        if not topics:  # nothing was recorded, or the file's index does not say what
            topics = {entry.key for entry in _all_messages(file)}
        parsed = map(keys.parse, topics)
        found.update(topic for topic in parsed if topic is not None and topic.kind == keys.SAMPLE)
    return found


def one_plant_in(path: Path, plant: str | None = None) -> str:
    """The given plant, or the only one of the recording.

    Raises:
        InputError: there are no samples, or none of the given plant, or several plants and none was given.
    """
    plants = plants_in(path)
    if not plants:
        raise InputError(f"{path}: holds no samples")
    if plant is None and len(plants) > 1:
        raise InputError(f"{path}: holds samples of several plants; name one of {', '.join(plants)}")
    if plant is not None and plant not in plants:
        raise InputError(f"{path}: holds no samples of plant {plant!r} (there are: {', '.join(plants)})")
    return plant or plants[0]


def read_metadata(path: Path) -> dict[str, str]:
    """Metadata of the recording, or of the first file of a folder; empty if another program wrote it.

    Raises:
        InputError: as `read_messages`.
    """
    return own_metadata(metadata_records(recordings_in(path)[0]))


def recorded_process(path: Path, plant: str | None) -> Process | None:
    """Process of a plant, or of the only plant, as the recording describes it; None: it does not.

    Raises:
        InputError: as `read_messages`.
    """
    found = processes_in(record for file in recordings_in(path) for record in metadata_records(file))
    if plant is None:
        return next(iter(found.values())) if len(found) == 1 else None
    return found.get(plant)


def read_record(path: Path, plant: str | None = None, process: Process | None = None) -> Record:
    """Samples of one plant as rows of equal sample time; runs are split by `RunSplitter`.

    Args:
        path: the recording.
        plant: name of the plant; None if the recording has only one.
        process: process whose signals are read, its inputs and outputs in any case; None: all recorded signals.

    Returns:
        The signals in the units in which they were published, in the order of their process if there is one; NaN where
        a signal has no sample at the time of another one, or no valid one. The first of duplicate samples in a run
        counts, and stray samples are counted as `strays`. Time counts from `zero_ns` of the metadata, else from the
        first sample of the first run.

    Raises:
        InputError: as `read_messages` and `one_plant_in`; or there are no samples of the process.
    """
    plant = one_plant_in(path, plant)
    wanted = None if process is None else {signal.name for signal in process.signals}
    names: dict[str, str | None] = {}
    series = SampleSeries()
    signals: list[str] = []
    payloads: list[bytes] = []
    batch = FIRST_BATCH
    for entry in read_messages(path, {keys.SAMPLE}, plant):
        key = entry.key
        if key not in names:
            name = key.split("/", 3)[3]
            names[key] = name if wanted is None or name in wanted else None
        signal = names[key]
        if signal is None or entry.encoding != SAMPLE:
            continue
        signals.append(signal)
        payloads.append(entry.payload)
        if len(signals) == batch:
            series.add(signals, payloads)
            signals, payloads, batch = [], [], BATCH
    series.add(signals, payloads)
    runs, splitter, units = series.runs, series.splitter, series.units
    if not runs:
        sought = "that can be used" if process is None else f"of {', '.join(item.name for item in process.signals)}"
        raise InputError(f"{path}: holds no samples {sought} of plant {plant!r}")
    metadata = read_metadata(path)
    zero_ns = zero_from(metadata, splitter.runs[0].first_ns)
    present = {name: units.get(name, "") for of_run in runs for name in of_run}
    needed = () if process is None else (*process.inputs, *process.outputs)
    if process is None and (process := recorded_process(path, plant)) is not None:
        needed = tuple(signal.name for signal in process.signals)
    columns = signal_roles({**dict.fromkeys(needed, ""), **present}, process)
    full = [of_run for of_run in runs if any(times for times, _ in of_run.values())]
    rows = [_rows(of_run, columns, zero_ns, path.name) for of_run in full]
    clock_ns = zero_ns if has_clock(metadata) else 0
    return replace(join_runs(rows), zero_ns=clock_ns, strays=splitter.strays, units=units)


def zero_from(metadata: dict[str, str], first_ns: int) -> int:
    """Time that minutes of a recording count from: its metadata, else its first sample."""
    try:
        return int(metadata.get(ZERO_NS, first_ns))
    except ValueError:
        return first_ns


def has_clock(metadata: dict[str, str]) -> bool:
    """True if the times of a recording are clock times."""
    return metadata.get(CLOCK) != NO_CLOCK and metadata.get(ZERO_NS) != "0"


def _rows(
    series: dict[str, tuple["array[int]", "array[float]"]], names: Iterable[str], zero_ns: int, name: str
) -> Record:
    """Rows of one run, from times and values by signal."""
    all_times = np.unique(np.concatenate([np.asarray(times, np.int64) for times, _ in series.values()]))
    columns = {signal: np.full(all_times.size, np.nan) for signal in names}
    for signal, (times, values) in series.items():
        own_times, first = np.unique(np.asarray(times, np.int64), return_index=True)
        columns[signal][np.searchsorted(all_times, own_times)] = np.asarray(values)[first]
    return Record((all_times - zero_ns) / MINUTE_NS, columns, name)


class _File(NamedTuple):
    """Recording and its index; `first` is True for the first or only file."""

    path: Path
    summary: Summary
    span: tuple[int, int]
    first: bool


def _all_messages(file: _File) -> Iterator[RecordedMessage]:
    """Messages of a file in the order of receipt, whatever the file's order is."""
    return sorted_messages(file.path, file.summary) if is_indexed(file.summary) else unindexed_messages(file.path)


def _files(path: Path) -> list[_File]:
    if not path.is_dir():
        summary = read_summary(path)
        return [_File(path, summary, span_ns(summary), first=True)]
    read = [(file, read_summary(file)) for file in list_files(path, ".mcap")]
    if not read:
        raise InputError(f"{path}: holds no recording (.mcap)")
    spans = [(span_ns(summary), file, summary) for file, summary in read]
    found = sorted((item for item in spans if item[0] != (0, 0)), key=lambda item: item[:2]) or spans[:1]
    return [_File(file, summary, span, first=not index) for index, (span, file, summary) in enumerate(found)]
