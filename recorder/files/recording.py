"""Read a recording, one file or several: https://mcap.dev/spec. Files are written by `recorder.files.writer`.

The topic of a message is its key, its log time the time of receipt, its publish time the sample time. Messages of this
software carry their protobuf schema, so that any program reads them. Other messages are recorded with the encoding
that they claimed and no schema. The metadata records are those of `recorder.files.metadata`.

Several files are read as one recording, one after the other in the order of time, or interleaved where times overlap.
Latched messages are skipped in all files but the first. Where a folder holds only a file that is still being recorded,
the intact part of that is read.
"""

import heapq
from collections.abc import Callable, Collection, Iterable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple, TypeVar

from mcap.summary import Summary

from reactorwatch.contract import keys
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError
from reactorwatch.records.input_file import list_files
from recorder import RecordedMessage
from recorder.files.index import LATEST_NS, read_summary, span_ns
from recorder.files.metadata import CLOCK, NO_CLOCK, ZERO_NS, own_metadata, processes_in
from recorder.files.part_file import PART, is_locked
from recorder.files.reader import Reader, StoredMessage, Wanted, metadata_records

MAX_TOPICS = 5
"""Topics of other programs that an error names."""


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
            summary = read_summary(path)
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

    def is_selected(key: str) -> bool:
        topic = keys.parse(key)
        if topic is None:
            return kinds is None and plant is None
        return (kinds is None or topic.kind in kinds) and (plant is None or topic.plant == plant)

    sources = _sources_in(path)  # not within a generator: errors are raised at the call
    return (stored.recorded_message for stored in merge_messages(sources, wanted=is_selected))


def recordings_in(path: Path) -> list[Path]:
    """Files of a recording in the order of their times: the path itself, or the files in the folder.

    Raises:
        InputError: a file is damaged, or the folder holds none.
    """
    return [source.path for source in _sources_in(path)]


def live_file(folder: Path) -> Path | None:
    """The newest file of a folder that is being recorded, if it holds no complete recording; None: there is none."""
    if not folder.is_dir() or list_files(folder, ".mcap"):
        return None
    return next((file for file in reversed(list_files(folder, PART)) if is_locked(file)), None)


def _sources_in(path: Path) -> list[SourceFile]:
    if not path.is_dir():
        return open_sources([path])
    files = list_files(path, ".mcap")
    live = live_file(path)
    if not files and live is None:
        left = next(iter(list_files(path, PART)), None)
        cure = "" if left is None else f"; {left.name} is left of a recorder that was killed: `reactorwatch recover` it"
        raise InputError(f"{path}: holds no recording (.mcap){cure}")
    sources = open_sources(files) if live is None else open_sources([live], tolerant=True)
    held = [source for source in sources if source.span != (0, 0)] or sources[:1]
    return [source._replace(first=not index) for index, source in enumerate(held)]


def sample_topics_in(path: Path) -> set[keys.Topic]:
    """Topics of the samples in the recording.

    Raises:
        InputError: as `read_messages`.
    """
    found: set[keys.Topic] = set()
    for source in _sources_in(path):
        topics = {topic for topic, _ in source.topics}
        if not topics:  # nothing was recorded, or the file's index does not say what
            topics = {stored.channel.key for stored in Reader(source.path, tolerant=source.summary is None)}
        parsed = map(keys.parse, topics)
        found.update(topic for topic in parsed if topic is not None and topic.kind == keys.SAMPLE)
    return found


def plants_in(path: Path) -> tuple[str, ...]:
    """Plants with samples in the recording, in alphabetical order.

    Raises:
        InputError: as `read_messages`.
    """
    return tuple(sorted({topic.plant for topic in sample_topics_in(path)}))


def one_plant_in(path: Path, plant: str | None = None) -> str:
    """The given plant, or the only one of the recording.

    Raises:
        InputError: there are no samples, or none of the given plant, or several plants and none was given.
    """
    plants = plants_in(path)
    if not plants:
        raise no_samples_error(path)
    if plant is None and len(plants) > 1:
        raise InputError(f"{path}: holds samples of several plants; name one of {', '.join(plants)}")
    if plant is not None and plant not in plants:
        raise InputError(f"{path}: holds no samples of plant {plant!r} (there are: {', '.join(plants)})")
    return plant or plants[0]


def no_samples_error(path: Path) -> InputError:
    """Error of a recording without samples, with what is there instead in one of another program."""
    text = f"{path}: holds no samples"
    if read_metadata(path):
        return InputError(text)
    topics = {item for source in _sources_in(path) for item in source.topics}
    found = sorted(f"{topic!r} ({encoding or 'no encoding'})" for topic, encoding in topics)
    more = f" and {len(found) - MAX_TOPICS} more" if len(found) > MAX_TOPICS else ""
    there = f"topics {', '.join(found[:MAX_TOPICS])}{more}" if found else "no index of its topics"
    return InputError(
        f"{text}: another program wrote it, with {there}; samples are messages reactorwatch.v1.Sample (protobuf) on "
        f"{keys.ROOT}/PLANT/{keys.SAMPLE}/SIGNAL; convert it to a table, and `import` that"
    )


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
