"""Copies of recordings: of what a damaged one still holds (`recover`), and of a time window (`cut`).

Messages are copied unchanged, with channels, metadata and attachments. Payloads are not decoded, so files of other
programs are copied as well. A recovery copies all that a tolerant reader finds, in its order. A cut starts with latched
messages, as any file of a recorder does; see `recorder.keep`.
"""

import contextlib
import os
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import structlog

from reactorwatch.contract import keys
from reactorwatch.errors import InputError
from reactorwatch.records.write import atomic_write, refuse_source
from recorder import RecordedMessage, StoredMessage
from recorder.files.index import LATEST_NS
from recorder.files.reader import Damage, Reader, read_start, select_topics
from recorder.files.recording import SourceFile, merge_messages, open_sources, own_metadata, parse_gap
from recorder.files.writer import METADATA, PART, RecordingWriter, is_locked, lock_orphan
from recorder.keep import LATCHED_KINDS, FileNames, LatchedMessages
from recorder.samples import content_of

log = structlog.get_logger()

RECOVERED = "recovered"
"""Name of the metadata record about the damage, in a recovered file."""
DAMAGED = ".damaged"
"""Ending of an orphan that was recovered in part only; it is retained like a recording."""


@dataclass(frozen=True)
class RecoveryResult:
    """Result of a recovery.

    Attributes:
        messages: number of recovered messages.
        first_ns: time of receipt of the first.
        last_ns: time of receipt of the last.
        topics: number of messages by topic.
        damages: unreadable parts; empty if the file was intact.
        orphans: number of messages that were skipped because their channel is described nowhere.
    """

    messages: int
    first_ns: int
    last_ns: int
    topics: dict[str, int]
    damages: tuple[Damage, ...]
    orphans: int

    @property
    def is_only_truncated(self) -> bool:
        """True if nothing is missing but the end of the file."""
        return all(damage.is_end for damage in self.damages) and not self.orphans

    @property
    def losses(self) -> str:
        """Text about the lost parts, five of them and the number of the others; empty if there are none."""
        texts = [str(damage) for damage in self.damages[:5]]
        if len(self.damages) > len(texts):
            texts.append(f"{len(self.damages) - len(texts)} more places")
        if self.orphans:
            texts.append(f"{self.orphans} messages of channels that are described nowhere")
        return "; ".join(texts)


def recover(path: Path, out: Path) -> RecoveryResult:
    """Copy the intact parts of a file into a new one, dated by its last message.

    Args:
        path: the damaged file; it is not changed.
        out: the new file; an existing one is replaced if any message was recovered.

    Raises:
        InputError: no message can be recovered, or the new file cannot be written or is the damaged one.
    """
    refuse_source(out, (path,))
    start, reader = read_start(path), Reader(path, tolerant=True)
    topics: Counter[str] = Counter()
    first_ns, last_ns = 2**64, 0
    with atomic_write(out) as temporary:
        with RecordingWriter(temporary, own_metadata(start.metadata), profile=start.profile) as writer:
            for stored in reader:
                writer.append(stored)
                topics[stored.channel.key] += 1
                first_ns, last_ns = min(first_ns, stored.log_time_ns), max(last_ns, stored.log_time_ns)
            for attachment in reader.attachments():
                writer.add_attachment(attachment)
            saved = RecoveryResult(
                topics.total(), first_ns, last_ns, dict(topics), tuple(reader.damages), reader.orphans
            )
            if not saved.messages:
                raise InputError(f"{path}: holds no message that could be saved ({saved.losses or 'it is whole'})")
            for record in reader.metadata:
                if record.name != METADATA:
                    writer.add_metadata(record.name, record.metadata)
            if saved.losses:
                writer.add_metadata(RECOVERED, {"from": path.name, "lost": saved.losses})
        with contextlib.suppress(OSError, OverflowError):  # the file system cannot represent the time
            os.utime(temporary, ns=(last_ns, last_ns))
    return saved


def find_orphans(names: FileNames) -> list[Path]:
    """Find files left by crashed recorders, and delete their unfinished repairs.

    Raises:
        InputError: the named file is being written by another recorder.
    """
    orphans = []
    for part in sorted(names.folder.glob(f"*{PART}")):
        name = part.name.removesuffix(PART)
        if names.owns(name):
            if not is_locked(part):
                orphans.append(part)
            elif not names.dated:
                raise InputError(f"recording {part.with_name(name)}: {part} is being written by another recorder")
    delete_partial_copies(names.folder, names.stem)
    return orphans


def delete_partial_copies(folder: Path, start: str) -> None:
    """Delete the unfinished copies of a killed recorder whose names have this start."""
    for copy in folder.glob(f".{start}*.tmp{PART}"):
        if not is_locked(copy):
            copy.unlink(missing_ok=True)


def list_damaged(names: FileNames) -> list[Path]:
    """Orphans that were recovered in part only."""
    ending = PART + DAMAGED
    return [path for path in names.folder.glob(f"*{ending}") if names.owns(path.name.removesuffix(ending))]


def repair(part: Path) -> None:
    """Recover an orphan, which is deleted only if nothing but its end is missing."""
    with lock_orphan(part):
        path = part.with_name(part.name.removesuffix(PART))
        if path.exists() and not _is_recovered_from(path, part):
            path = path.with_name(f"{path.stem}-recovered{path.suffix}")
        if _is_empty(part):
            part.unlink()
            log.info("nothing was in it yet", file=str(part))
            return
        try:
            saved = recover(part, path)
        except InputError as error:
            part.rename(part.with_name(part.name + DAMAGED))
            log.warning("nothing recovered", why=str(error))
            return
        if saved.is_only_truncated:
            part.unlink()
        else:
            part.rename(part.with_name(part.name + DAMAGED))
        log.info("recovered", file=str(path), messages=saved.messages, lost=saved.losses)


def _is_empty(part: Path) -> bool:
    """True if an orphan has no message."""
    try:
        reader = Reader(part, tolerant=True)
        return not any(True for _ in reader) and not reader.orphans and all(item.is_end for item in reader.damages)
    except InputError:
        return part.stat().st_size == 0


def _is_recovered_from(path: Path, part: Path) -> bool:
    """True if `path` was recovered from `part` by a recorder that crashed before it deleted `part`."""
    try:
        origin = own_metadata(read_start(part).metadata)
        return own_metadata(read_start(path).metadata) == origin != {}
    except InputError:
        return False


class Window(NamedTuple):
    """Time window, both ends included.

    Attributes:
        received_ns: range of times of receipt.
        sampled_ns: range of sample times, which applies instead to messages that have one; None if it never applies.
    """

    received_ns: tuple[int, int]
    sampled_ns: tuple[int, int] | None = None

    def side_of(self, stored: StoredMessage) -> int:
        """-1 for a message before the window, 0 for one in it, 1 for one after it."""
        (from_ns, to_ns), at_ns = self.received_ns, stored.log_time_ns
        if self.sampled_ns is not None and has_sample_time(stored.channel.key):
            (from_ns, to_ns), at_ns = self.sampled_ns, stored.publish_time_ns
        return (at_ns > to_ns) - (at_ns < from_ns)


def sample_window(sources: Sequence[Path], from_ns: int, to_ns: int) -> Window:
    """Window of messages about samples of a time, and of other messages received meanwhile.

    Raises:
        InputError: there is no such sample; or as `cut`.
    """
    first_ns, last_ns = LATEST_NS, 0
    for stored in merge_messages(open_sources(sources), wanted=has_sample_time):
        if not stored.channel.latched and from_ns <= stored.publish_time_ns <= to_ns:
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
    files = open_sources(sources, tolerant=tolerant)
    refuse_source(out, sources)
    count = 0
    with atomic_write(out) as temporary, RecordingWriter(temporary, metadata, profile=_profile(files)) as writer:
        for stored in merge_messages(files, *window.received_ns, tolerant=tolerant):
            if stored.channel.latched or window.side_of(stored):
                continue
            if not count:
                for entry in _latched_messages(files, window, stored.log_time_ns):
                    writer.write(entry)
            writer.append(stored)
            count += 1
        if not count:
            raise InputError(f"{sources[0]}: holds no message of that time")
        _copy_metadata(files, writer, window.received_ns)
    return count


def has_sample_time(topic: str) -> bool:
    """True if messages of a topic carry sample time, not clock time."""
    parsed = keys.parse(topic)
    return parsed is not None and parsed.kind != keys.HEALTH


def _latched_messages(sources: Sequence[SourceFile], window: Window, start_ns: int) -> list[RecordedMessage]:
    """Latched messages at the start of the window."""
    latched = LatchedMessages()
    for source in sources:
        if source.span[0] > start_ns:
            continue
        for stored in Reader(source.path, to_ns=start_ns, wanted=select_topics(LATCHED_KINDS), tolerant=True):
            if not (stored.channel.latched or window.side_of(stored) < 0):
                continue
            recorded = stored.recorded_message
            if (content := content_of(recorded)) is not None:
                latched.update(recorded, content)
    return latched.messages(start_ns)


def _copy_metadata(sources: Sequence[SourceFile], writer: RecordingWriter, received_ns: tuple[int, int]) -> None:
    """Copy metadata and attachments, equal ones once.

    Gaps are copied if they are within the time, and the metadata of this software are not copied.
    """
    written: list[object] = []
    for source in sources:
        reader = Reader(source.path, wanted=lambda _: False, tolerant=True)
        deque(reader, maxlen=0)
        for record in reader.metadata:
            gap = parse_gap(record)
            if gap is not None and not received_ns[0] <= gap.noticed_ns <= received_ns[1]:
                continue
            if record.name != METADATA and (gap is not None or record not in written):
                writer.add_metadata(record.name, record.metadata)
                written.append(record)
        for attachment in reader.attachments():
            if attachment not in written:
                writer.add_attachment(attachment)
                written.append(attachment)


def _profile(sources: Sequence[SourceFile]) -> str:
    """Profile that all sources share; empty if they differ."""
    profiles = {read_start(source.path).profile for source in sources}
    return profiles.pop() if len(profiles) == 1 else ""
