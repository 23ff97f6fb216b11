"""Recovery of a damaged recording into a new file.

Everything that `mcap_scan` can read is copied in its order, with channels, metadata and attachments. Payloads are not
decoded, so files of other programs are recovered as well.
"""

import contextlib
import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.output import refuse_source
from recorder.storage.mcap_scan import Damage, Scan, profile_of
from recorder.storage.mcap_writer import METADATA, RecordingWriter, own_metadata

RECOVERED = "recovered"
"""Name of the metadata record about the damage, in a recovered file."""
_MAX_LISTED = 5  # damages listed in a text; the others are counted


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
        """Text about the lost parts; empty if there are none."""
        texts = [str(damage) for damage in self.damages[:_MAX_LISTED]]
        if len(self.damages) > _MAX_LISTED:
            texts.append(f"{len(self.damages) - _MAX_LISTED} more places")
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
    scan = Scan(path)
    topics: Counter[str] = Counter()
    first_ns, last_ns = 2**64, 0
    with atomic_write(out) as temporary:
        with RecordingWriter(temporary, read_origin(path), profile=profile_of(path)) as writer:
            for stored in scan:
                writer.copy(stored)
                topics[stored.channel.topic] += 1
                first_ns, last_ns = min(first_ns, stored.log_time_ns), max(last_ns, stored.log_time_ns)
            for attachment in scan.attachments():
                writer.add_attachment(attachment)
            saved = RecoveryResult(topics.total(), first_ns, last_ns, dict(topics), tuple(scan.damages), scan.orphans)
            if not saved.messages:
                raise InputError(f"{path}: holds no message that could be saved ({saved.losses or 'it is whole'})")
            for record in scan.metadata:
                if record.name != METADATA:
                    writer.add_metadata(record.name, record.metadata)
            if saved.losses:
                writer.add_metadata(RECOVERED, {"from": path.name, "lost": saved.losses})
        with contextlib.suppress(OSError, OverflowError):  # the file system cannot represent the time
            os.utime(temporary, ns=(last_ns, last_ns))
    return saved


def read_origin(path: Path) -> dict[str, str]:
    """Metadata that the recorder wrote at the start of a file, damaged or not; empty if there are none.

    Raises:
        InputError: the file contains nothing of a recording.
    """
    scan = Scan(path)
    next(iter(scan), None)
    return own_metadata(scan.metadata)
