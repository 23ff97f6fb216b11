"""Recordings out of recordings: a stretch of time (`cut`), or several as one (`merge`).

Messages are copied as they are, of whatever program. What a stretch says first is how things stood at its beginning, as
at the beginning of any file of ours; see `head`.
"""

import heapq
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap.records import Attachment, Metadata

from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, decode
from reactorwatch.errors import InputError
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.output import refuse_source
from recorder.message import RecordedMessage
from recorder.policy.latched import LatchedMessages
from recorder.storage.gaps import GAP, from_metadata
from recorder.storage.mcap_chunks import damage_error, read_summary, span_ns
from recorder.storage.mcap_scan import LATEST_NS, RawMessage, Scan, Wanted, profile_of
from recorder.storage.mcap_writer import METADATA, RecordingWriter
from recorder.tools.overlap import in_turn

STANDING = frozenset({keys.MODEL, keys.ALARM, keys.FAULT})
"""Kinds of messages whose last one tells how things stand."""


class Window(NamedTuple):
    """A stretch of time, both ends included.

    Attributes:
        received_ns: of the times of receipt.
        sampled_ns: of the times of samples, by which all is judged that speaks of one; None: all is by its receipt.
    """

    received_ns: tuple[int, int]
    sampled_ns: tuple[int, int] | None = None

    def holds(self, stored: RawMessage) -> bool:
        """Whether a message is in it."""
        if self.sampled_ns is not None and speaks_of_a_sample(stored.channel.topic):
            return self.sampled_ns[0] <= stored.publish_time_ns <= self.sampled_ns[1]
        return self.received_ns[0] <= stored.log_time_ns <= self.received_ns[1]

    def is_after(self, stored: RawMessage) -> bool:
        """Whether a message was there before it began."""
        if self.sampled_ns is not None and speaks_of_a_sample(stored.channel.topic):
            return stored.publish_time_ns < self.sampled_ns[0]
        return stored.log_time_ns < self.received_ns[0]


def received_between(from_ns: int, to_ns: int) -> Window:
    """The window of what was received within a time."""
    return Window((from_ns, to_ns))


def sampled_between(sources: Sequence[Path], from_ns: int, to_ns: int) -> Window:
    """The window of what speaks of samples of a time, and of what else was received meanwhile.

    Raises:
        InputError: there is no such sample; or as `cut`.
    """
    first_ns, last_ns = LATEST_NS, 0
    for stored in _in_order(_sources(sources), wanted=speaks_of_a_sample):
        if not stored.latched and from_ns <= stored.publish_time_ns <= to_ns:
            first_ns, last_ns = min(first_ns, stored.log_time_ns), max(last_ns, stored.log_time_ns)
    if first_ns > last_ns:
        raise InputError(f"{sources[0]}: holds no sample of that time")
    return Window((first_ns, last_ns), (from_ns, to_ns))


def cut(
    sources: Sequence[Path], out: Path, window: Window, metadata: Mapping[str, str], *, tolerant: bool = False
) -> int:
    """Copy a stretch of time into a recording of its own.

    Args:
        sources: recordings that follow each other.
        out: the new one; an older file of that name is replaced.
        window: the stretch.
        metadata: what the new one says about its origin.
        tolerant: pass over what is damage_error, and take a file as it is that is still being written.

    Returns:
        The number of messages in the stretch, without what is said again at its beginning.

    Raises:
        InputError: nothing was received then, a source is damage_error, or the new file cannot be written.
    """
    if not sources:
        raise InputError(f"{out.name}: there is no recording of that time; were its files deleted?")
    found = _sources(sources, tolerant=tolerant)
    refuse_source(out, sources)
    count = 0
    with atomic_write(out) as temporary, RecordingWriter(temporary, metadata, profile=_profile(found)) as writer:
        for stored in _in_order(found, window.received_ns, tolerant=tolerant):
            if stored.latched or not window.holds(stored):
                continue
            if not count:
                for entry in _standing(found, window, stored.log_time_ns):
                    writer.write(entry)
            writer.copy(stored)
            count += 1
        if not count:
            raise InputError(f"{sources[0]}: holds no message of that time")
        _copy_the_rest(found, writer, window.received_ns)
    return count


def merge(sources: Sequence[Path], out: Path, metadata: Mapping[str, str]) -> int:
    """Put several recordings into one, in the order of receipt.

    Args:
        sources: the recordings; what one says again of those before it is left out.
        out: the new one; an older file of that name is replaced.
        metadata: what the new one says about its origin.

    Returns:
        The number of messages.

    Raises:
        InputError: a source is damage_error, or the new file cannot be written.
    """
    found = _sources(sources)
    refuse_source(out, sources)
    count = 0
    with atomic_write(out) as temporary, RecordingWriter(temporary, metadata, profile=_profile(found)) as writer:
        for stored in _in_order(found):
            writer.copy(stored)
            count += 1
        _copy_the_rest(found, writer)
    return count


def speaks_of_a_sample(topic: str) -> bool:
    """Whether the messages of a topic have the time of a sample, and not that of a clock."""
    parsed = keys.parse(topic)
    return parsed is not None and parsed.kind != keys.HEALTH


@dataclass(frozen=True)
class _Source:
    path: Path
    span: tuple[int, int]
    first: bool


def _sources(paths: Sequence[Path], *, tolerant: bool = False) -> list[_Source]:
    """The files in the order of their beginnings."""
    spans = []
    for path in paths:
        try:
            span = span_ns(read_summary(path))
        except InputError:
            if not tolerant:
                raise
            begin = next(iter(Scan(path)), None)
            span = (begin.log_time_ns if begin is not None else 0, LATEST_NS)
        spans.append((span, path))
    spans.sort()
    return [_Source(path, span, first=not number) for number, (span, path) in enumerate(spans)]


def _in_order(
    sources: Sequence[_Source],
    received_ns: tuple[int, int] = (0, LATEST_NS),
    *,
    wanted: Wanted | None = None,
    tolerant: bool = False,
) -> Iterator[RawMessage]:
    """The messages of all files in the order of receipt; each file for itself is taken to be in order."""
    from_ns, to_ns = received_ns

    def of(source: _Source) -> Iterator[RawMessage]:
        scan = Scan(source.path, from_ns, to_ns, wanted)
        for stored in scan:
            if source.first or not stored.latched:
                yield stored
        if not (scan.is_intact or tolerant):
            raise damage_error(source.path, "; ".join(map(str, scan.damages)) or "some channels are described nowhere")

    within = [source for source in sources if source.span[1] >= from_ns and source.span[0] <= to_ns]
    for group in in_turn(within, lambda source: source.span):
        yield from heapq.merge(*map(of, group), key=lambda stored: stored.log_time_ns)


def _standing(sources: Sequence[_Source], window: Window, begun_ns: int) -> list[RecordedMessage]:
    """How things stood when the window began."""
    head = LatchedMessages()

    def wanted(topic: str) -> bool:
        parsed = keys.parse(topic)
        return parsed is not None and parsed.kind in STANDING

    for source in sources:
        if source.span[0] > begun_ns:
            continue
        for stored in Scan(source.path, to_ns=begun_ns, wanted=wanted):
            if not (stored.latched or window.is_after(stored)):
                continue
            entry = stored.recorded
            try:
                head.update(entry, decode(entry.payload, entry.encoding))
            except DecodeError:
                continue
    return head.messages(begun_ns)


def _copy_the_rest(
    sources: Sequence[_Source], writer: RecordingWriter, received_ns: tuple[int, int] = (0, LATEST_NS)
) -> None:
    """Write what programs say about the sources and what they attached to them; what several say alike, once.

    What was lost on the way is said of the time that is copied, and our own metadata are new.
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
    """The profile that all sources name; empty if they name several."""
    profiles = {profile_of(source.path) for source in sources}
    return profiles.pop() if len(profiles) == 1 else ""
