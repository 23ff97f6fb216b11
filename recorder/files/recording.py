"""Read a recording, one file or several: https://mcap.dev/spec. Files are written by `recorder.files.writer`.

The topic of a message is its key, its log time the time of receipt, its publish time the sample time. Messages of this
software carry their protobuf schema, so that any program reads them. Other messages are recorded with the encoding
that they claimed and no schema.

Several files are read as one recording, one after the other in the order of time, or interleaved where times overlap.
Latched messages are skipped in all files but the first. Where a folder holds only a file that is still being recorded,
the intact part of that is read.

There is a metadata record of the file itself (the version that wrote it, and details of its origin), one of each
plant's process (its signals with their units and roles, and its equations) and one of each gap: messages lost on the
bus. Publishers number their messages (`reactorwatch.runtime.reorder_buffer`), so the number and the range of lost
messages is known.

Equations of the catalogue are stored by name, with the constants that differ and the deviations that the model holds,
and other ones as data (`process.extended_model`). Effects of a user's code are neither: a recording of a process that
has some is read with the process named by an option.
"""

import heapq
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple, TypeVar

import msgspec
from mcap.records import Metadata
from mcap.summary import Summary

from reactorwatch.contract import keys
from reactorwatch.description.process import KnownParameter, Process, Signal, describe_model
from reactorwatch.errors import InputError
from reactorwatch.limits import parse_json
from reactorwatch.process import own_effects
from reactorwatch.process.extended_model import parse_extended_model, stored_model
from reactorwatch.records.decode import list_files
from reactorwatch.records.record import Record
from reactorwatch.runtime.reorder_buffer import Gap
from recorder import RecordedMessage, StoredMessage
from recorder.files.index import LATEST_NS, span_ns
from recorder.files.reader import Reader, Wanted, metadata_records, select_topics
from recorder.files.writer import METADATA, PART, is_locked

FILE_INDEX = "file"
"""Key in it: index of the file within its run, from 1, if a recorder wrote it."""
PROCESS = "reactorwatch.process"
"""Name of the records of processes."""
GAP = "reactorwatch.gap"
"""Name of the records of gaps."""
ZERO_NS = "zero_ns"
"""Key of the time that minutes count from, where that is not the first sample."""
CLOCK, NO_CLOCK = "clock", "none"
"""Key and value: the record had no clock time, and its times were shifted so that none is before 1970."""


def own_metadata(records: Iterable[Metadata]) -> dict[str, str]:
    """Metadata that this software wrote, among those of all programs; empty if there are none."""
    return next((record.metadata for record in records if record.name == METADATA), {})


def gap_metadata(gap: Gap) -> dict[str, str]:
    """Metadata record of a gap."""
    noticed = datetime.fromtimestamp(gap.noticed_ns / 1e9, UTC).isoformat(timespec="milliseconds")
    values = {name: str(value) for name, value in gap._asdict().items()}
    return {**values, "publisher": f"{gap.publisher:016x}", "noticed": noticed}


def parse_gap(record: Metadata) -> Gap | None:
    """Gap of a metadata record; None if it is not one of a gap."""
    if record.name != GAP:
        return None
    try:
        stream, publisher, *numbers = (record.metadata[name] for name in Gap._fields)
        return Gap(stream, int(publisher, 16), *map(int, numbers))
    except (KeyError, ValueError):
        return None


def gaps_of(records: Iterable[Metadata]) -> tuple[Gap, ...]:
    """Gaps among metadata records."""
    return tuple(gap for gap in map(parse_gap, records) if gap is not None)


def process_metadata(plant: str, process: Process, record: Record | None = None) -> dict[str, str]:
    """Metadata record of the signals of a process.

    Args:
        plant: name of the plant.
        process: the process.
        record: a record, which decides which signals there are, and their units; None: all of them, in their units.
    """
    model_units = {} if process.model is None else process.model.units
    present = []
    for signal in process.signals:
        if record is None:
            present.append(replace(signal, unit=signal.unit or model_units.get(signal.name, ""), column=None))
        elif signal.name in record.columns:
            present.append(replace(signal, unit=record.units.get(signal.name, ""), column=None))
    signals = [{name: value for name, value in asdict(signal).items() if value not in (None, "")} for signal in present]
    found = {"plant": plant, "process": process.name, "signals": msgspec.json.encode(signals).decode()}
    if model_units.keys() <= {signal.name for signal in present}:
        found |= _equations_metadata(process)
    return found


def processes_in(records: Iterable[Metadata]) -> dict[str, Process]:
    """Processes by name of the plant; of several records of a plant the first counts.

    Records that cannot be read, such as those of a later version, are skipped, and so are equations.
    """
    found: dict[str, Process] = {}
    for record in records:
        if record.name == PROCESS and record.metadata.get("plant") not in (None, *found):
            try:
                signals = msgspec.convert(parse_json(record.metadata["signals"]), tuple[Signal, ...])
                process = Process(record.metadata["process"], signals)
            except (KeyError, msgspec.MsgspecError, InputError):
                continue
            with suppress(KeyError, msgspec.MsgspecError, InputError):
                process = _with_equations(process, record.metadata)
            found[record.metadata["plant"]] = process
    return found


def _equations_metadata(process: Process) -> dict[str, str]:
    """Metadata of the equations and their given constants; empty if its effects are code of the user."""
    model = process.equations
    if model is None or model.breakpoints:  # times of deviations count from a zero that is not known here
        return {}
    extended = stored_model(model)
    if process.effects != (own_effects(model) if extended.equations is None else ()):
        return {}
    given = {name: KnownParameter.of(item) for name, item in process.parameters.items()}
    return {
        "equations": msgspec.json.encode(extended.to_object()).decode(),
        "parameters": msgspec.json.encode(given).decode(),
        **({"generic": "true"} if process.generic else {}),
    }


def _with_equations(process: Process, metadata: dict[str, str]) -> Process:
    """Process with the equations of its metadata and, from the catalogue, their effects and controllers.

    Raises:
        KeyError: there are none.
        InputError: they cannot be built.
        msgspec.MsgspecError: they are no such JSON.
    """
    named = describe_model(parse_extended_model(metadata["equations"]).build())
    parameters = msgspec.convert(parse_json(metadata["parameters"]), dict[str, KnownParameter])
    return replace(
        named,
        name=process.name,
        signals=process.signals,
        parameters=parameters,
        file_format=process.file_format,
        generic="generic" in metadata,
    )


class SourceFile(NamedTuple):
    """File of a recording.

    Attributes:
        path: the file.
        span: times of receipt of the first and the last message.
        summary: index of the file; None if there is none that can be read.
        first: True for the first or only file.
    """

    path: Path
    span: tuple[int, int]
    summary: Summary | None
    first: bool

    @property
    def topics(self) -> list[tuple[str, str]]:
        """Topic and message encoding of each channel in the index."""
        channels = {} if self.summary is None else self.summary.channels
        return [(channel.topic, channel.message_encoding) for channel in channels.values()]


def open_sources(paths: Iterable[Path], *, tolerant: bool = False) -> list[SourceFile]:
    """Files in the order of their first messages.

    Args:
        paths: the files.
        tolerant: True to accept damaged files and those that are still being written.

    Raises:
        InputError: a file is damaged.
    """
    found: list[tuple[tuple[int, int], Path, Summary | None]] = []
    for path in paths:
        try:
            summary = Reader(path).summary
            found.append((span_ns(summary), path, summary))
        except InputError:
            if not tolerant:
                raise
            first = next(iter(Reader(path, tolerant=True)), None)
            found.append(((first.log_time_ns if first is not None else 0, LATEST_NS), path, None))
    found.sort(key=lambda item: item[:2])
    return [SourceFile(path, span, summary, not index) for index, (span, path, summary) in enumerate(found)]


def merge_messages(
    sources: Iterable[SourceFile],
    from_ns: int = 0,
    to_ns: int = LATEST_NS,
    wanted: Wanted | None = None,
    *,
    tolerant: bool = False,
) -> Iterator[StoredMessage]:
    """Messages of all files in the order of receipt; those of equal time in the order of the files.

    Args:
        sources: the files, of any size; one chunk of each is in memory at a time.
        from_ns: chunks that were received entirely before this time are skipped.
        to_ns: chunks that were received entirely after this time are skipped.
        wanted: selects the topics to read; None reads all.
        tolerant: True to skip damage. Each file is then taken to be in order, as a recorder writes it.

    Raises:
        InputError: a file is damaged, when the pass reaches it.
    """

    def read(source: SourceFile) -> Iterator[StoredMessage]:
        is_tolerant = tolerant or source.summary is None
        reader = Reader(source.path, from_ns, to_ns, wanted, tolerant=is_tolerant)
        for stored in reader if is_tolerant else reader.in_order():
            if source.first or not stored.channel.latched:
                yield stored

    within = [source for source in sources if source.span[1] >= from_ns and source.span[0] <= to_ns]
    for group in group_overlapping(within, lambda source: source.span):
        yield from heapq.merge(*map(read, group), key=attrgetter("log_time_ns"))


class Recording:
    """A recording: one file, or all files of a folder.

    Args:
        path: file or folder of any size; one chunk of each file is in memory at a time.

    Attributes:
        path: the file or folder.
        files: the files in the order of their times.
        live: file whose intact part is read, because it is still being recorded; None: the recording is complete.

    Raises:
        InputError: the file does not exist, is no MCAP file, or is damaged; or the folder holds none. Damage within a
            chunk is raised when messages or metadata are read from it.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.live = path, live_file(path)
        if not path.is_dir():
            self._sources = open_sources([path])
        elif self.live is not None:
            self._sources = open_sources([self.live], tolerant=True)
        else:
            files = list_files(path, ".mcap")
            if not files:
                part = next(iter(list_files(path, PART)), None)
                cure = f"; {part.name} is left of a recorder that was killed: `reactorwatch recover` it" if part else ""
                raise InputError(f"{path}: holds no recording (.mcap){cure}")
            sources = open_sources(files)
            held = [source for source in sources if source.span != (0, 0)] or sources[:1]
            self._sources = [source._replace(first=not index) for index, source in enumerate(held)]
        self.files = [source.path for source in self._sources]
        self._records: dict[Path, list[Metadata]] = {}

    def messages(self, kinds: Collection[str] | None = None, plant: str | None = None) -> Iterator[RecordedMessage]:
        """Messages in the order of receipt; those of equal time in the order of the file.

        Args:
            kinds: kinds to read, such as `keys.SAMPLE`; None for all, other programs' keys included.
            plant: plant to read; None for all.
        """
        wanted = select_topics(kinds, plant)
        return (stored.recorded_message for stored in merge_messages(self._sources, wanted=wanted))

    @property
    def metadata_by_file(self) -> list[dict[str, str]]:
        """Metadata of each file, empty if another program wrote it."""
        return [own_metadata(self._records_of(file)) for file in self.files]

    @property
    def metadata(self) -> dict[str, str]:
        """Metadata of the first file."""
        return own_metadata(self._records_of(self.files[0]))

    @property
    def metadata_records(self) -> list[Metadata]:
        """Metadata records of all files, those of other programs included."""
        return [record for file in self.files for record in self._records_of(file)]

    def process(self, plant: str | None) -> Process | None:
        """Process of a plant, or of the only plant, as the recording describes it; None: it does not."""
        found = processes_in(self.metadata_records)
        if plant is None:
            return next(iter(found.values())) if len(found) == 1 else None
        return found.get(plant)

    @cached_property
    def sample_topics(self) -> set[keys.Topic]:
        """Topics of the samples."""
        found: set[keys.Topic] = set()
        for source in self._sources:
            topics = {topic for topic, _ in source.topics}
            if not topics:  # nothing was recorded, or the file's index does not say what
                topics = {stored.channel.key for stored in Reader(source.path, tolerant=source.summary is None)}
            parsed = map(keys.parse, topics)
            found.update(topic for topic in parsed if topic is not None and topic.kind == keys.SAMPLE)
        return found

    @property
    def plants(self) -> tuple[str, ...]:
        """Plants with samples, in alphabetical order."""
        return tuple(sorted({topic.plant for topic in self.sample_topics}))

    def one_plant(self, plant: str | None = None) -> str:
        """The given plant, or the only one.

        Raises:
            InputError: there are no samples, or none of the given plant, or several plants and none was given.
        """
        plants = self.plants
        if not plants:
            raise self.no_samples_error()
        if plant is None and len(plants) > 1:
            raise InputError(f"{self.path}: holds samples of several plants; name one of {', '.join(plants)}")
        if plant is not None and plant not in plants:
            raise InputError(f"{self.path}: holds no samples of plant {plant!r} (there are: {', '.join(plants)})")
        return plant or plants[0]

    def no_samples_error(self) -> InputError:
        """Error of a recording without samples; of one of another program it names five of its topics."""
        text = f"{self.path}: holds no samples"
        if self.metadata:
            return InputError(text)
        topics = {item for source in self._sources for item in source.topics}
        found = sorted(f"{topic!r} ({encoding or 'no encoding'})" for topic, encoding in topics)
        more = f" and {len(found) - 5} more" if len(found) > 5 else ""
        there = f"topics {', '.join(found[:5])}{more}" if found else "no index of its topics"
        return InputError(
            f"{text}: another program wrote it, with {there}; samples are messages reactorwatch.v1.Sample (protobuf) "
            f"on {keys.ROOT}/PLANT/{keys.SAMPLE}/SIGNAL; convert it to a table, and `import` that"
        )

    def _records_of(self, file: Path) -> list[Metadata]:
        """Metadata records of one file, read when they are needed: those of a later file may be damaged."""
        if file not in self._records:
            self._records[file] = metadata_records(file)
        return self._records[file]


def live_file(folder: Path) -> Path | None:
    """The newest file of a folder that is being recorded, if it holds no complete recording; None: there is none."""
    if not folder.is_dir() or list_files(folder, ".mcap"):
        return None
    return next((file for file in reversed(list_files(folder, PART)) if is_locked(file)), None)


def zero_from(metadata: dict[str, str], first_ns: int) -> int:
    """Time that minutes of a recording count from: its metadata, else its first sample."""
    try:
        return int(metadata.get(ZERO_NS, first_ns))
    except ValueError:
        return first_ns


def has_clock(metadata: dict[str, str]) -> bool:
    """True if the times of a recording are clock times."""
    return metadata.get(CLOCK) != NO_CLOCK and metadata.get(ZERO_NS) != "0"


Item = TypeVar("Item")


def group_overlapping(items: Iterable[Item], span: Callable[[Item], tuple[int, int]]) -> list[list[Item]]:
    """Group items so that groups follow each other in time, and times overlap within a group.

    Args:
        items: items in the order of their starts.
        span: returns start and end of an item.

    >>> group_overlapping(["ad", "bc", "de", "fg"], lambda item: (ord(item[0]), ord(item[1])))
    [['ad', 'bc'], ['de'], ['fg']]
    """
    groups: list[list[Item]] = []
    last = -1
    for item in items:
        first, end = span(item)
        if groups and first < last:
            groups[-1].append(item)
        else:
            groups.append([item])
        last = max(last, end)
    return groups
