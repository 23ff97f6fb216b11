"""What is whole in a damaged recording, into a recording that is whole.

Everything that `mcap_scan` can read is written again in the order in which it is, with the descriptions of its
channels, what programs said about the file and what they attached to it; the bytes of the messages are not looked into,
so files of other programs are recovered as well.
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
"""In our metadata of a recovered file: what could not be read."""
_MOST_TOLD = 5  # places that are named; the others are counted


@dataclass(frozen=True)
class Saved:
    """What could be saved.

    Attributes:
        messages: how many.
        first_ns: when the first of them was received.
        last_ns: likewise, the last.
        topics: messages by topic.
        damages: the places that could not be read; empty if the file was whole.
        orphans: messages that were passed over because their channel is described nowhere any more.
    """

    messages: int
    first_ns: int
    last_ns: int
    topics: dict[str, int]
    damages: tuple[Damage, ...]
    orphans: int

    @property
    def only_cut_off(self) -> bool:
        """Whether nothing is missing but the end, which had not been written yet."""
        return all(damage.cut_off for damage in self.damages) and not self.orphans

    @property
    def lost(self) -> str:
        """What could not be saved, in words; empty if there is nothing of that sort."""
        told = [str(damage) for damage in self.damages[:_MOST_TOLD]]
        if len(self.damages) > _MOST_TOLD:
            told.append(f"{len(self.damages) - _MOST_TOLD} more places")
        if self.orphans:
            told.append(f"{self.orphans} messages of channels that are described nowhere")
        return "; ".join(told)


def recover(path: Path, out: Path) -> Saved:
    """Write what is whole in a file into another one, which then has the age of its last message.

    Args:
        path: the damaged file; it stays as it is.
        out: the new one; an older file of that name is replaced, if anything could be saved.

    Raises:
        InputError: there is nothing to save, or the new file cannot be written, or is the damaged one.
    """
    refuse_source(out, (path,))
    scan = Scan(path)
    topics: Counter[str] = Counter()
    first_ns, last_ns = 2**64, 0
    with atomic_write(out) as temporary:
        with RecordingWriter(temporary, origin(path), profile=profile_of(path)) as writer:
            for stored in scan:
                writer.copy(stored)
                topics[stored.channel.topic] += 1
                first_ns, last_ns = min(first_ns, stored.log_time_ns), max(last_ns, stored.log_time_ns)
            for attachment in scan.attachments():
                writer.add_attachment(attachment)
            saved = Saved(topics.total(), first_ns, last_ns, dict(topics), tuple(scan.damages), scan.orphans)
            if not saved.messages:
                raise InputError(f"{path}: holds no message that could be saved ({saved.lost or 'it is whole'})")
            for record in scan.metadata:
                if record.name != METADATA:
                    writer.add_metadata(record.name, record.metadata)
            if saved.lost:
                writer.add_metadata(RECOVERED, {"from": path.name, "lost": saved.lost})
        with contextlib.suppress(OSError, OverflowError):  # a time that no file can have
            os.utime(temporary, ns=(last_ns, last_ns))
    return saved


def origin(path: Path) -> dict[str, str]:
    """What our own record in a file, damaged or not, says; empty if there is none. It stands at the very beginning.

    Raises:
        InputError: nothing in it looks like a recording.
    """
    scan = Scan(path)
    next(iter(scan), None)
    return own_metadata(scan.metadata)
