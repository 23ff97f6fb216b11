"""Recordings as MCAP files, read: https://mcap.dev/spec. They are written by `mcap_writer`.

The topic of a message is its key, its log time the time of receipt, its publish time that of its sample. Messages of
ours carry their protobuf schema, so that any program reads them; a stranger's bytes are kept with the encoding that
they claimed and no schema.

Our metadata record, "reactorwatch", says which version wrote the file and what else its writer thought worth knowing;
`zero_ns` in it is the time that minutes are counted from, where that is not the first sample. Where `clock` in it is
`none`, the times are those of a record without clock time, shifted so that none is before 1970.

A folder is read as one recording: the files in it in the order of their times, and each in turn, or together where
their times overlap. What a file says again of the one before it is passed over, but in the first.
"""

import heapq
from array import array
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.summary import Summary

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import DecodeError, decode, encoding_of
from reactorwatch.errors import InputError
from reactorwatch.records.input_file import list_files
from reactorwatch.records.record import MINUTE_NS, UNITS, Record, join_runs
from recorder.columns.measurement import measured
from recorder.columns.run_splitter import RunSplitter
from recorder.message import RecordedMessage
from recorder.storage.mcap_chunks import (
    is_in_order,
    metadata_records,
    ordered_messages,
    read_summary,
    sorted_messages,
    span_ns,
)
from recorder.storage.mcap_writer import RecordingWriter, own_metadata
from recorder.tools.overlap import in_turn

__all__ = ["RecordingWriter", "plants_in", "read_messages", "read_metadata", "read_record", "recordings_in"]

ZERO_NS = "zero_ns"
CLOCK, NO_CLOCK = "clock", "none"

_SAMPLE = encoding_of(messages.Sample)


def read_messages(
    path: Path, kinds: Collection[str] | None = None, plant: str | None = None
) -> Iterator[RecordedMessage]:
    """The messages of a recording in the order in which they were received; those of equal time as in the file.

    Args:
        path: the file or the folder; of any size, a chunk of each file is in memory at a time.
        kinds: only these, such as `keys.SAMPLE`; None for all, also what has no key of ours.
        plant: only those of this plant.

    Raises:
        InputError: the file is not there, is no MCAP file, or is damaged. Damage within a chunk is raised when
            the reading comes there.
    """
    groups = in_turn(
        _files(path), lambda file: file.span
    )  # not within a generator: what is wrong is raised at the call

    def wanted(key: str) -> bool:
        topic = keys.parse(key)
        if topic is None:
            return kinds is None and plant is None
        return (kinds is None or topic.kind in kinds) and (plant is None or topic.plant == plant)

    def of(file: _File) -> Iterator[RecordedMessage]:
        if is_in_order(file.summary):
            numbers = {number for number, channel in file.summary.channels.items() if wanted(channel.topic)}
            found = ordered_messages(file.path, file.summary, numbers)
        else:
            found = (entry for entry in sorted_messages(file.path, file.summary) if wanted(entry.key))
        return found if file.first else (entry for entry in found if not entry.latched)

    if len(groups) == len(groups[0]) == 1:
        return of(groups[0][0])
    return (entry for group in groups for entry in heapq.merge(*map(of, group), key=lambda entry: entry.log_time_ns))


def recordings_in(path: Path) -> list[Path]:
    """The files of a recording in the order of their times: the path itself, or those in the folder that it is.

    Raises:
        InputError: a file is damaged, or the folder holds none.
    """
    return [file.path for file in _files(path)]


def plants_in(path: Path) -> tuple[str, ...]:
    """The plants that the recording has samples of, in alphabetical order.

    Raises:
        InputError: as `read_messages`.
    """
    found: set[str] = set()
    for file in _files(path):
        topics = {channel.topic for channel in file.summary.channels.values()}
        if not topics:  # nothing was recorded, or the file's index does not say what
            topics = {entry.key for entry in sorted_messages(file.path, file.summary)}
        parsed = map(keys.parse, topics)
        found.update(topic.plant for topic in parsed if topic is not None and topic.kind == keys.SAMPLE)
    return tuple(sorted(found))


def one_plant_in(path: Path, plant: str | None = None) -> str:
    """The plant that is asked for, or the only one there is.

    Raises:
        InputError: there are no samples, or none of this plant, or of several plants and none was named.
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
    """What the recording, or the first of a folder, says about its origin; empty if it is not one of ours.

    Raises:
        InputError: as `read_messages`.
    """
    return own_metadata(metadata_records(recordings_in(path)[0]))


def read_record(path: Path, plant: str | None = None) -> Record:
    """The samples of one plant as rows of equal sample time; see `RunSplitter` for where a new run starts.

    Args:
        path: the recording.
        plant: whose samples; may be left out if there is but one plant in it.

    Returns:
        The three signals; NaN where one has no sample at a time that another has, or none that is finite and not of
        bad quality. Where a sample came twice in a run the first counts, and samples that are out of place are counted
        as `strays`. The time is counted from `zero_ns` of the
        file's metadata, else from the first sample of the first run.

    Raises:
        InputError: as `read_messages` and `one_plant_in`; or a sample cannot be decoded.
    """
    plant = one_plant_in(path, plant)
    signals = {keys.key(plant, keys.SAMPLE, signal): signal for signal in UNITS}
    runs: list[dict[str, tuple[array[int], array[float]]]] = []
    newest: dict[str, tuple[array[int], array[float]]] = {}  # by signal, where its newest sample is
    units: dict[str, str] = {}
    splitter = RunSplitter()
    for entry in read_messages(path, {keys.SAMPLE}, plant):
        if entry.key not in signals or entry.encoding != _SAMPLE:
            continue
        try:
            sample: Any = decode(entry.payload, entry.encoding)
        except DecodeError:
            continue  # the recorder has counted it as refused
        value = measured(sample)
        if value is not None:
            signal, strays = signals[entry.key], splitter.strays
            number = splitter.update(signal, sample.sequence, sample.time_ns)
            if splitter.strays > strays:
                for column in newest[signal]:
                    column.pop()
            if number > len(runs):
                runs.append({signal: (array("q"), array("d")) for signal in UNITS})
            if sample.unit:
                units.setdefault(signal, sample.unit)
            newest[signal] = times, values = runs[number - 1][signal]
            times.append(sample.time_ns)
            values.append(value)
    if not runs:
        raise InputError(f"{path}: holds no samples of {', '.join(UNITS)} of plant {plant!r}")
    metadata = read_metadata(path)
    zero_ns = zero_from(metadata, splitter.runs[0].first_ns)
    rows = [_rows(series, zero_ns, path.name) for series in runs if any(times for times, _ in series.values())]
    clock_ns = zero_ns if has_clock(metadata) else 0
    return replace(join_runs(rows), zero_ns=clock_ns, strays=splitter.strays, units=units)


def zero_from(metadata: dict[str, str], first_ns: int) -> int:
    """The time that the minutes of a recording count from: what its metadata says, else its first sample."""
    try:
        return int(metadata.get(ZERO_NS, first_ns))
    except ValueError:
        return first_ns


def has_clock(metadata: dict[str, str]) -> bool:
    """Whether the times of a recording are clock times."""
    return metadata.get(CLOCK) != NO_CLOCK and metadata.get(ZERO_NS) != "0"


def _rows(series: dict[str, tuple["array[int]", "array[float]"]], zero_ns: int, name: str) -> Record:
    """The samples of one run, by signal their times and values, as rows."""
    all_times = np.unique(np.concatenate([np.asarray(times, np.int64) for times, _ in series.values()]))
    columns = {signal: np.full(all_times.size, np.nan) for signal in series}
    for signal, (times, values) in series.items():
        own_times, first = np.unique(np.asarray(times, np.int64), return_index=True)
        columns[signal][np.searchsorted(all_times, own_times)] = np.asarray(values)[first]
    return Record((all_times - zero_ns) / MINUTE_NS, columns, name)


class _File(NamedTuple):
    """A recording and its index; `first` of its folder, or the only one."""

    path: Path
    summary: Summary
    span: tuple[int, int]
    first: bool


def _files(path: Path) -> list[_File]:
    if not path.is_dir():
        summary = read_summary(path)
        return [_File(path, summary, span_ns(summary), first=True)]
    read = [(file, read_summary(file)) for file in list_files(path, ".mcap")]
    if not read:
        raise InputError(f"{path}: holds no recording (.mcap)")
    spans = [(span_ns(summary), file, summary) for file, summary in read]
    found = sorted((item for item in spans if item[0] != (0, 0)), key=lambda item: item[:2]) or spans[:1]
    return [_File(file, summary, span, first=not number) for number, (span, file, summary) in enumerate(found)]
