"""Copy a time window of recordings (`cut`), or merge several recordings (`merge`).

Messages of any program are copied unchanged. A cut starts with latched messages, as any file of a recorder does; see
`recorder.policy.latched`.
"""

import heapq
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, decode
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.output import refuse_source
from recorder.message import RecordedMessage
from recorder.policy.latched import LatchedMessages
from recorder.storage.gaps import GAP, from_metadata
from recorder.storage.mcap_chunks import read_summary, span_ns
from recorder.storage.mcap_scan import LATEST_NS, RawMessage, Scan, Wanted, profile_of
from recorder.storage.mcap_types import Attachment, Metadata
from recorder.storage.mcap_writer import METADATA, RecordingWriter
from recorder.tools.overlap import group_overlapping

LATCHED_KINDS = frozenset({keys.MODEL, keys.ALARM, keys.BASELINE, keys.PROMISE, keys.FAULT})
"""Kinds of messages that are latched."""


class Window(NamedTuple):
    """Time window, both ends included.

    Attributes:
        received_ns: range of times of receipt.
        sampled_ns: range of sample times, which applies instead to messages that have one; None if it never applies.
    """

    received_ns: tuple[int, int]
    sampled_ns: tuple[int, int] | None = None

    def contains(self, stored: RawMessage) -> bool:
        """True if a message is in the window."""
        if self.sampled_ns is not None and has_sample_time(stored.channel.topic):
            return self.sampled_ns[0] <= stored.publish_time_ns <= self.sampled_ns[1]
        return self.received_ns[0] <= stored.log_time_ns <= self.received_ns[1]

    def starts_after(self, stored: RawMessage) -> bool:
        """True if the window starts after a message."""
        if self.sampled_ns is not None and has_sample_time(stored.channel.topic):
            return stored.publish_time_ns < self.sampled_ns[0]
        return stored.log_time_ns < self.received_ns[0]


def receipt_window(from_ns: int, to_ns: int) -> Window:
    """Window of messages received within a time."""
    return Window((from_ns, to_ns))


def sample_window(sources: Sequence[Path], from_ns: int, to_ns: int) -> Window:
    """Window of messages about samples of a time, and of other messages received meanwhile.

    Raises:
        InputError: there is no such sample; or as `cut`.
    """
    first_ns, last_ns = LATEST_NS, 0
    for stored in _merged_messages(_sources(sources), wanted=has_sample_time):
        if not stored.latched and from_ns <= stored.publish_time_ns <= to_ns:
            first_ns, last_ns = min(first_ns, stored.log_time_ns), max(last_ns, stored.log_time_ns)
    if first_ns > last_ns:
        raise InputError(f"{sources[0]}: holds no sample of that time")
    return Window((first_ns, last_ns), (from_ns, to_ns))


def cut(
    sources: Sequence[Path], out: Path, window: Window, metadata: Mapping[str, str], *, tolerant: bool = False
) -> int:
    """Copy a time window into a new recording.

    Args:
        sources: recordings that follow each other.
        out: the new recording; an existing file is replaced.
        window: the time window.
        metadata: metadata of the new recording.
        tolerant: True to skip damage and accept a file that is still being written.

    Returns:
        Number of copied messages, latched ones excluded.

    Raises:
        InputError: the window is empty, a source is damaged, or the new file cannot be written.
    """
    if not sources:
        raise InputError(f"{out.name}: there is no recording of that time; were its files deleted?")
    files = _sources(sources, tolerant=tolerant)
    refuse_source(out, sources)
    count = 0
    with atomic_write(out) as temporary, RecordingWriter(temporary, metadata, profile=_profile(files)) as writer:
        for stored in _merged_messages(files, window.received_ns, tolerant=tolerant):
            if stored.latched or not window.contains(stored):
                continue
            if not count:
                for entry in _latched_messages(files, window, stored.log_time_ns):
                    writer.write(entry)
            writer.copy(stored)
            count += 1
        if not count:
            raise InputError(f"{sources[0]}: holds no message of that time")
        _copy_metadata(files, writer, window.received_ns)
    return count


def merge(sources: Sequence[Path], out: Path, metadata: Mapping[str, str]) -> int:
    """Merge several recordings in the order of receipt.

    Args:
        sources: the recordings; latched messages of all but the first are left out.
        out: the new recording; an existing file is replaced.
        metadata: metadata of the new recording.

    Returns:
        Number of messages.

    Raises:
        InputError: a source is damaged, or the new file cannot be written.
    """
    files = _sources(sources)
    refuse_source(out, sources)
    count = 0
    with atomic_write(out) as temporary, RecordingWriter(temporary, metadata, profile=_profile(files)) as writer:
        for stored in _merged_messages(files):
            writer.copy(stored)
            count += 1
        _copy_metadata(files, writer)
    return count


def has_sample_time(topic: str) -> bool:
    """True if messages of a topic carry sample time, not clock time."""
    parsed = keys.parse(topic)
    return parsed is not None and parsed.kind != keys.HEALTH


@dataclass(frozen=True)
class _Source:
    path: Path
    span: tuple[int, int]
    first: bool


def _sources(paths: Sequence[Path], *, tolerant: bool = False) -> list[_Source]:
    """Files in the order of their first messages."""
    spans = []
    for path in paths:
        try:
            span = span_ns(read_summary(path))
        except InputError:
            if not tolerant:
                raise
            first = next(iter(Scan(path)), None)
            span = (first.log_time_ns if first is not None else 0, LATEST_NS)
        spans.append((span, path))
    spans.sort()
    return [_Source(path, span, first=not index) for index, (span, path) in enumerate(spans)]


def _merged_messages(
    sources: Sequence[_Source],
    received_ns: tuple[int, int] = (0, LATEST_NS),
    *,
    wanted: Wanted | None = None,
    tolerant: bool = False,
) -> Iterator[RawMessage]:
    """Messages of all files in the order of receipt, assuming that each file is in order."""
    from_ns, to_ns = received_ns

    def read(source: _Source) -> Iterator[RawMessage]:
        scan = Scan(source.path, from_ns, to_ns, wanted)
        for stored in scan:
            if source.first or not stored.latched:
                yield stored
        if not tolerant:
            scan.check_intact()

    within = [source for source in sources if source.span[1] >= from_ns and source.span[0] <= to_ns]
    for group in group_overlapping(within, lambda source: source.span):
        yield from heapq.merge(*map(read, group), key=lambda stored: stored.log_time_ns)


def _latched_messages(sources: Sequence[_Source], window: Window, start_ns: int) -> list[RecordedMessage]:
    """Latched messages at the start of the window."""
    latched = LatchedMessages()

    def is_latched(topic: str) -> bool:
        parsed = keys.parse(topic)
        return parsed is not None and parsed.kind in LATCHED_KINDS

    for source in sources:
        if source.span[0] > start_ns:
            continue
        for stored in Scan(source.path, to_ns=start_ns, wanted=is_latched):
            if not (stored.latched or window.starts_after(stored)):
                continue
            recorded = stored.recorded_message
            try:
                latched.update(recorded, decode(recorded.payload, recorded.encoding))
            except DecodeError:
                continue
    return latched.messages(start_ns)


def _copy_metadata(
    sources: Sequence[_Source], writer: RecordingWriter, received_ns: tuple[int, int] = (0, LATEST_NS)
) -> None:
    """Copy metadata and attachments, equal ones once.

    Gaps are copied if they are within the time, and the metadata of this software are not copied.
    """
    written: list[Metadata | Attachment] = []
    for source in sources:
        scan = Scan(source.path, wanted=lambda _: False)
        deque(scan, maxlen=0)
        for record in scan.metadata:
            gap = from_metadata(record.metadata) if record.name == GAP else None
            if gap is not None and not received_ns[0] <= gap.noticed_ns <= received_ns[1]:
                continue
            if record.name != METADATA and (gap is not None or record not in written):
                writer.add_metadata(record.name, record.metadata)
                written.append(record)
        for attachment in scan.attachments():
            if attachment not in written:
                writer.add_attachment(attachment)
                written.append(attachment)


def _profile(sources: Sequence[_Source]) -> str:
    """Profile that all sources share; empty if they differ."""
    profiles = {profile_of(source.path) for source in sources}
    return profiles.pop() if len(profiles) == 1 else ""
