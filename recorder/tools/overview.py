"""What is in a recording: how much, from when to when, what is missing, which alarms. Pure."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import DecodeError, decode
from recorder.columns.run_splitter import RunSpan, RunSplitter
from recorder.message import RecordedMessage

MOST_GAPS = 1000
"""Gaps that are named; more are counted only."""


@dataclass
class Topic:
    """What came on one key.

    Attributes:
        key: the key.
        encoding: of the first message.
        count: messages.
        first_ns: when the first was received.
        last_ns: when the last was received.
    """

    key: str
    encoding: str
    count: int
    first_ns: int
    last_ns: int


@dataclass
class Gap:
    """Samples of one key that are missing, by their sequence numbers."""

    key: str
    first: int
    last: int
    after_ns: int
    """Time of the sample before the gap."""


class Raised(NamedTuple):
    """An alarm that came up; times are those of samples; `cleared_ns` is None if it still stands at the end."""

    alarm: str
    priority: int
    raised_ns: int
    cleared_ns: int | None
    text: str


@dataclass
class Overview:
    """What is in a recording.

    Attributes:
        topics: by key.
        first_ns: when the first message was received; 0 if there is none.
        last_ns: likewise, the last.
        runs: of each plant, the times of its first and its last sample in each run.
        lost: samples that are missing.
        duplicated: samples that are there again.
        out_of_order: samples after a later one.
        out_of_place: samples with a number or time that fits neither those before nor those after.
        gaps: which are missing.
        alarms: in the order in which they came up.
    """

    topics: dict[str, Topic] = field(default_factory=dict)
    first_ns: int = 0
    last_ns: int = 0
    runs: dict[str, list[RunSpan]] = field(default_factory=dict)
    lost: int = 0
    duplicated: int = 0
    out_of_order: int = 0
    out_of_place: int = 0
    gaps: list[Gap] = field(default_factory=list)
    alarms: list[Raised] = field(default_factory=list)

    @property
    def messages(self) -> int:
        """All of them, without what is said again at the beginning."""
        return sum(topic.count for topic in self.topics.values())

    @property
    def sample_span_ns(self) -> RunSpan | None:
        """The times of the first and the last sample; None if there is none."""
        spans = [span for runs in self.runs.values() for span in runs]
        return RunSpan(min(span.first_ns for span in spans), max(span.last_ns for span in spans)) if spans else None

    @property
    def starts_ns(self) -> int | None:
        """The time of the first sample of the first run; None if there is none."""
        return min((runs[0].first_ns for runs in self.runs.values()), default=None)

    @property
    def span_s(self) -> float:
        """From the first to the last receipt."""
        return (self.last_ns - self.first_ns) / 1e9


def overview(entries: Iterable[RecordedMessage]) -> Overview:
    """Look over a recording.

    Args:
        entries: in the order of receipt; what is said again counts for the alarms alone.
    """
    seen = Overview()
    checks: dict[str, _Check | None] = {}
    splitters: dict[str, RunSplitter] = {}
    standing: dict[str, int] = {}
    for entry in entries:
        if not entry.latched:
            _count(seen, entry)
        if entry.key not in checks:
            checks[entry.key] = _Check.of(entry.key, splitters)
        check = checks[entry.key]
        if check is None:
            continue
        try:
            message: Any = decode(entry.payload, entry.encoding)
        except DecodeError:
            continue
        if isinstance(message, messages.Alarm):
            _follow(seen, standing, message)
        elif isinstance(message, messages.Sample) and message.quality != messages.QUALITY_UNSPECIFIED:
            check.update(message)
    seen.runs = {plant: splitter.runs for plant, splitter in splitters.items() if splitter.runs}
    for sequence in (item for splitter in splitters.values() for item in splitter.checks.values()):
        seen.lost += sequence.lost
        seen.duplicated += sequence.duplicated
        seen.out_of_order += sequence.out_of_order
        seen.out_of_place += sequence.out_of_place
    for check in filter(None, checks.values()):
        seen.gaps += check.gaps
    seen.gaps.sort(key=lambda gap: (gap.after_ns, gap.key))
    del seen.gaps[MOST_GAPS:]
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


def _follow(seen: Overview, standing: dict[str, int], alarm: messages.Alarm) -> None:
    """An alarm that comes up is noted, and so is its end; one that stood before the recording began is noted too."""
    number = standing.get(alarm.alarm)
    known = number is not None and seen.alarms[number].raised_ns == alarm.raised_ns
    if alarm.raised_ns and not known and (alarm.event == "raised" or not alarm.cleared_ns):
        standing[alarm.alarm] = len(seen.alarms)
        seen.alarms.append(Raised(alarm.alarm, alarm.priority, alarm.raised_ns, None, alarm.text))
    elif number is not None and known and alarm.cleared_ns and seen.alarms[number].cleared_ns is None:
        seen.alarms[number] = seen.alarms[number]._replace(cleared_ns=alarm.cleared_ns)


class _Check:
    """The sequence numbers of one key, and which of them are missing."""

    def __init__(self, key: str, signal: str, splitter: RunSplitter) -> None:
        self._key, self._signal, self._splitter = key, signal, splitter
        self._skipped = False
        self.gaps: list[Gap] = []

    @classmethod
    def of(cls, key: str, splitters: dict[str, RunSplitter]) -> "_Check | None":
        """The check of a key, with the runs of its plant; None if nothing on it has to be looked into."""
        topic = keys.parse(key)
        if topic is None or topic.kind not in (keys.SAMPLE, keys.ALARM):
            return None
        return cls(key, topic.name, splitters.setdefault(topic.plant, RunSplitter()))

    def update(self, sample: messages.Sample) -> None:
        """Look at one sample."""
        check, number = self._splitter.checks.get(self._signal), sample.sequence
        before, after_ns = (check.lost, check.newest_ns) if check is not None else (0, 0)
        strays = check.out_of_place if check is not None else 0
        self._splitter.update(self._signal, number, sample.time_ns)
        check = self._splitter.checks[self._signal]
        if check.out_of_place > strays:  # the gap before it is none
            if self._skipped:
                gap = self.gaps.pop()
                before -= gap.last - gap.first + 1
            after_ns = 0
        missing = check.lost - before
        self._skipped = missing > 0 and len(self.gaps) < MOST_GAPS
        if self._skipped:
            self.gaps.append(Gap(self._key, number - missing, number - 1, after_ns))
        elif missing < 0:
            self._fill(number)

    def _fill(self, number: int) -> None:
        """A sample that was missing has come after all."""
        for place in range(len(self.gaps) - 1, -1, -1):
            gap = self.gaps[place]
            if gap.first <= number <= gap.last:
                rest = [(gap.first, number - 1), (number + 1, gap.last)]
                left = [Gap(gap.key, first, last, gap.after_ns) for first, last in rest if first <= last]
                self.gaps[place : place + 1] = left
                return
