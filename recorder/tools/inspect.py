"""Inspect a recording, a file in any state or the files in a folder: counts, time spans, gaps and alarms."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError
from reactorwatch.runtime.reorder_buffer import Gap
from recorder import RecordedMessage
from recorder.files.reader import Reader, read_start
from recorder.files.recording import Recording, gaps_of, own_metadata, processes_in, zero_from
from recorder.samples import Run, RunSplitter, content_of

MAX_GAPS = 1000
"""Gaps that are listed, more than is read; the others are counted."""


@dataclass
class Topic:
    """Messages of one key.

    Attributes:
        key: the key.
        encoding: encoding of the first message.
        count: number of messages.
        first_ns: time of receipt of the first.
        last_ns: time of receipt of the last.
    """

    key: str
    encoding: str
    count: int
    first_ns: int
    last_ns: int


@dataclass
class MissingSamples:
    """Missing samples of one key, by sequence number."""

    key: str
    first: int
    last: int
    after_ns: int
    """Time of the sample before the gap."""


class Raised(NamedTuple):
    """Raised alarm; times are sample times, and `cleared_ns` is None if it is active at the end."""

    alarm: str
    priority: int
    raised_ns: int
    cleared_ns: int | None
    text: str


@dataclass
class Overview:
    """Summary of a recording.

    Attributes:
        topics: topics by key.
        first_ns: time of receipt of the first message; 0 if there is none.
        last_ns: time of receipt of the last message; 0 if there is none.
        runs: time spans of the runs of each plant.
        lost: number of missing samples.
        duplicated: number of duplicate samples.
        out_of_order: number of samples received after a later one.
        out_of_place: number of stray samples.
        gaps: missing samples.
        alarms: alarms in the order in which they were raised.
    """

    topics: dict[str, Topic] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0
    runs: dict[str, list[Run]] = field(default_factory=dict)
    lost: int = 0
    duplicated: int = 0
    out_of_order: int = 0
    out_of_place: int = 0
    gaps: list[MissingSamples] = field(default_factory=list)
    alarms: list[Raised] = field(default_factory=list)

    @property
    def messages(self) -> int:
        """Number of messages, latched ones excluded."""
        return sum(topic.count for topic in self.topics.values())

    @property
    def sample_span_ns(self) -> tuple[int, int] | None:
        """Times of the first and the last sample; None if there is none."""
        runs = [run for of_plant in self.runs.values() for run in of_plant]
        return (min(run.first_ns for run in runs), max(run.last_ns for run in runs)) if runs else None

    @property
    def starts_ns(self) -> int | None:
        """Time of the first sample of the first run; None if there is none."""
        return min((runs[0].first_ns for runs in self.runs.values()), default=None)

    @property
    def span_s(self) -> float:
        """Time from the first to the last receipt, in seconds."""
        return (self.last_ns - self.first_ns) / 1e9


def overview(recording: Iterable[RecordedMessage]) -> Overview:
    """Summarise a recording.

    Args:
        recording: messages in the order of receipt; latched ones count for alarms only.
    """
    seen = Overview()
    lists: dict[str, _GapList | None] = {}
    splitters: dict[str, RunSplitter] = {}
    active: dict[str, int] = {}  # index of the newest alarm, by key
    for entry in recording:
        if not entry.latched:
            _count(seen, entry)
        if entry.key not in lists:
            lists[entry.key] = _GapList.of(entry.key, splitters)
        of_key = lists[entry.key]
        if of_key is None:
            continue
        message = content_of(entry)
        if isinstance(message, messages.Alarm):
            _follow(seen, active, entry.key, message)
        elif isinstance(message, messages.Sample) and message.quality != messages.QUALITY_UNSPECIFIED:
            of_key.update(message)
    seen.runs = {plant: splitter.runs for plant, splitter in splitters.items() if splitter.runs}
    for sequence in (item for splitter in splitters.values() for item in splitter.counters.values()):
        seen.lost += sequence.lost
        seen.duplicated += sequence.duplicated
        seen.out_of_order += sequence.out_of_order
        seen.out_of_place += sequence.out_of_place
    for of_key in filter(None, lists.values()):
        seen.gaps += of_key.gaps
    seen.gaps.sort(key=lambda gap: (gap.after_ns, gap.key))
    del seen.gaps[MAX_GAPS:]
    return seen


def _count(seen: Overview, entry: RecordedMessage) -> None:
    at_ns = entry.log_time_ns
    topic = seen.topics.get(entry.key)
    if topic is None:
        topic = seen.topics[entry.key] = Topic(entry.key, entry.encoding, 0, at_ns, at_ns)
    topic.count += 1
    topic.first_ns, topic.last_ns = min(topic.first_ns, at_ns), max(topic.last_ns, at_ns)
    seen.first_ns = min(seen.first_ns, at_ns) if seen.last_ns else at_ns
    seen.last_ns = max(seen.last_ns, at_ns)


def _follow(seen: Overview, active: dict[str, int], key: str, alarm: messages.Alarm) -> None:
    """Add a raised or latched alarm, or the time at which it cleared."""
    number = active.get(key)
    known = number is not None and seen.alarms[number].raised_ns == alarm.raised_ns
    if alarm.raised_ns and not known and (alarm.event == "raised" or not alarm.cleared_ns):
        active[key] = len(seen.alarms)
        seen.alarms.append(Raised(alarm.alarm, alarm.priority, alarm.raised_ns, None, alarm.text))
    elif number is not None and known and alarm.cleared_ns and seen.alarms[number].cleared_ns is None:
        seen.alarms[number] = seen.alarms[number]._replace(cleared_ns=alarm.cleared_ns)


class _GapList:
    """Missing samples of one key, with the sample before each; its counter, a gap tracker, counts them."""

    def __init__(self, key: str, signal: str, splitter: RunSplitter) -> None:
        self._key, self._signal, self._splitter = key, signal, splitter
        self._skipped = False
        self.gaps: list[MissingSamples] = []

    @classmethod
    def of(cls, key: str, splitters: dict[str, RunSplitter]) -> "_GapList | None":
        """List of a key, with the runs of its plant; None if the key is neither sample nor alarm."""
        topic = keys.parse(key)
        if topic is None or topic.kind not in (keys.SAMPLE, keys.ALARM):
            return None
        return cls(key, topic.name, splitters.setdefault(topic.plant, RunSplitter()))

    def update(self, sample: messages.Sample) -> None:
        """Process one sample."""
        check, number = self._splitter.counters.get(self._signal), sample.sequence
        before, after_ns = (check.lost, check.newest_ns) if check is not None else (0, 0)
        strays = check.out_of_place if check is not None else 0
        self._splitter.update(self._signal, number, sample.time_ns)
        check = self._splitter.counters[self._signal]
        if check.out_of_place > strays:  # the gap before a stray is none
            if self._skipped:
                gap = self.gaps.pop()
                before -= gap.last - gap.first + 1
            after_ns = 0
        missing = check.lost - before
        self._skipped = missing > 0 and len(self.gaps) < MAX_GAPS
        if self._skipped:
            self.gaps.append(MissingSamples(self._key, number - missing, number - 1, after_ns))
        elif missing < 0:
            self._fill(number)

    def _fill(self, number: int) -> None:
        """Remove a late sample from its gap."""
        for index in range(len(self.gaps) - 1, -1, -1):
            gap = self.gaps[index]
            if gap.first <= number <= gap.last:
                parts = [(gap.first, number - 1), (number + 1, gap.last)]
                self.gaps[index : index + 1] = [
                    MissingSamples(gap.key, first, last, gap.after_ns) for first, last in parts if first <= last
                ]
                return


@dataclass(frozen=True)
class FileInfo:
    """Content and condition of a recording.

    Attributes:
        overview: summary of the messages.
        metadata: metadata of the file, or of the first file of a folder.
        zero_ns: time that minutes count from.
        damages: unreadable parts; empty if the file is intact.
        gaps: messages lost on the bus before the recorder.
        processes: processes by plant, as the recording describes them.
        profile: MCAP profile of the file, or of the first of a folder; empty if it states none.
        library: program that wrote it, as it states itself.
        attachments: names of the attached files.
        live: name of the file whose intact part this is, because it is still being recorded; empty if it is complete.
    """

    overview: Overview
    metadata: dict[str, str]
    zero_ns: int
    damages: tuple[str, ...]
    gaps: tuple[Gap, ...] = ()
    processes: Mapping[str, Process] = field(default_factory=dict)
    profile: str = ""
    library: str = ""
    attachments: tuple[str, ...] = ()
    live: str = ""


def inspect(path: Path) -> FileInfo:
    """Inspect a recording; a single file may be damaged or still being written.

    Raises:
        InputError: it is no recording, or a file of the folder is damaged.
    """
    if path.is_dir():
        recording = Recording(path)
        found, reader, live = overview(recording.messages()), read_start(recording.files[0]), recording.live
        metadata, records, damages = recording.metadata, recording.metadata_records, list[str]()
    else:
        reader, live = Reader(path, tolerant=True), None
        found = overview(stored.recorded_message for stored in reader)
        metadata, records, damages = own_metadata(reader.metadata), reader.metadata, list(map(str, reader.damages))
        if reader.orphans:
            damages.append(f"{reader.orphans} messages of channels that are described nowhere")
    return FileInfo(
        overview=found,
        metadata=metadata,
        zero_ns=zero_from(metadata, found.starts_ns or 0),
        damages=tuple(damages),
        gaps=gaps_of(records),
        processes=processes_in(records),
        profile=reader.profile,
        library=reader.library,
        attachments=tuple(attached.name for attached in reader.attachments()),
        live="" if live is None else live.name,
    )


def zero_ns_of(recording: Recording) -> int:
    """Time that minutes of a recording count from: its metadata, else the first sample of its first run.

    Raises:
        InputError: it holds no sample, or it is damaged.
    """
    starts_ns = overview(recording.messages({keys.SAMPLE})).starts_ns
    if starts_ns is None:
        raise InputError(f"{recording.path}: holds no sample")
    return zero_from(recording.metadata, starts_ns)
