"""A recorder fed by hand with messages and a clock, recordings of given messages, and a disk that fills up."""

import errno
import os
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Body, Encoded, Publication, decode, encode
from reactorwatch.contract.messages_pb2 import Alarm, Health, Sample
from recorder import RecordedMessage
from recorder.config import RecorderConfig
from recorder.files.recording import Recording
from recorder.files.writer import PartFile, RecordingWriter, part_of
from recorder.node import RecorderNode
from recorder.recording_files import BootClock, RecordingFiles

SECOND = 1_000_000_000
MINUTE = 60 * SECOND


@dataclass
class Confirmed:
    """The clock since the machine's start; `now_ns` is set by the test."""

    now_ns: int
    boot: str = "a boot"

    def read(self) -> BootClock:
        return BootClock(self.boot, self.now_ns)


@dataclass
class Fed:
    """A recorder that is driven as the loop drives it."""

    node: RecorderNode
    files: RecordingFiles
    now_ns: int
    confirmed: Confirmed
    published: list[Publication] = field(default_factory=list)

    def receive(self, publications: Iterable[Publication], apart_ns: int) -> None:
        """Publish, one message each so often, and let it do what falls due between."""
        for publication in publications:
            self.pass_time(apart_ns)
            encoded = encode(publication)
            self.published += self.node.on_message(Encoded(*encoded[:3], self.now_ns), self.now_ns)

    def pass_time(self, span_ns: int) -> None:
        """Let nothing come for a while."""
        end_ns = self.now_ns + span_ns
        while (due_ns := self.node.next_tick_ns()) <= end_ns:
            self._move_on(max(self.now_ns, due_ns))
            self.published += self.node.on_tick(self.now_ns)
        self._move_on(end_ns)

    def _move_on(self, now_ns: int) -> None:
        self.confirmed.now_ns += now_ns - self.now_ns
        self.now_ns = now_ns

    def jump(self, span_ns: int) -> None:
        """Set the machine's clock, which no other clock confirms."""
        self.now_ns += span_ns

    def stop(self) -> None:
        """Ask it to end, and close its files."""
        self.published += self.node.on_stop(self.now_ns)
        with self.files:
            pass

    def kill(self) -> None:
        """What a kill does to its file: nothing that was not handed over gets there, and nobody holds it any more."""
        assert self.files.path is not None
        part = part_of(self.files.path)
        content = part.read_bytes()
        self.files.abandon()
        part.write_bytes(content)
        with self.files:
            pass

    def alarms(self) -> list[Alarm]:
        """The alarms that it has published."""
        return [item.message for item in self.published if isinstance(item.message, Alarm)]

    def last_health(self) -> Health:
        """Its last report."""
        return [item.message for item in self.published if isinstance(item.message, Health)][-1]


def recorder(
    out: Path,
    start_ns: int,
    open_part: Callable[[Path], PartFile] = PartFile,
    *,
    fingerprints: Collection[int] = (),
    fingerprints_until_ns: int = 0,
    boot: str = "a boot",
    **settings: object,
) -> Fed:
    """A recorder that has just begun."""
    config = RecorderConfig(out=str(out), **settings)  # type: ignore[arg-type]
    confirmed = Confirmed(start_ns, boot)
    files = RecordingFiles(config, open_part, confirmed.read)
    return Fed(RecorderNode(config, files, start_ns, fingerprints, fingerprints_until_ns), files, start_ns, confirmed)


class Disk:
    """A disk with so much room in bytes, shared by the files on it; as on a real one, a write may be taken in part."""

    def __init__(self, room: int = 10**9, error: int = errno.ENOSPC) -> None:
        self.room, self.error = room, error

    def open(self, path: Path) -> PartFile:
        disk = self

        class OnDisk(PartFile):
            def _append(self, data: bytearray) -> int:
                if not disk.room:
                    raise OSError(disk.error, os.strerror(disk.error))
                taken = super()._append(data[: disk.room])
                disk.room -= taken
                return taken

        return OnDisk(path)


def samples(count: int, first: int = 0) -> Iterator[Publication]:
    """Samples of a signal, a second apart."""
    for number in range(first, first + count):
        sample = Sample(time_ns=number * SECOND, sequence=number, value=1.0, quality=messages.QUALITY_GOOD)
        yield Publication(keys.key("cstr", keys.SAMPLE, "T"), sample)


def alarm(name: str, event: str = "raised") -> Publication:
    return Publication(keys.key("cstr", keys.ALARM, name), Alarm(time_ns=1, alarm=name, event=event))


def received(key: str, message: Body, received_ns: int = 0, *, latched: bool = False) -> RecordedMessage:
    """A message as a recorder receives it, at the time of its sample unless another is given."""
    time_ns: int = getattr(message, "time_ns", 0)
    encoded = encode(Publication(key, message))
    return RecordedMessage(*encoded[:3], received_ns or time_ns, time_ns, latched)


def recorded(
    path: Path, entries: Iterable[RecordedMessage], every: int = 0, metadata: dict[str, str] | None = None
) -> Path:
    """A recording of these messages, flushed after each so many of them."""
    with RecordingWriter(path, metadata or {}) as writer:
        for number, entry in enumerate(entries, start=1):
            writer.write(entry)
            if every and number % every == 0:
                writer.flush()
    return path


def of_others(path: Path) -> list[RecordedMessage]:
    """Messages of a recording without the recorder's own health reports."""
    return [entry for entry in Recording(path).messages() if not entry.key.endswith("health/recorder")]


def sequences(path: Path) -> list[int]:
    """Sequence numbers of the samples of a recording."""
    found = (decode(entry.payload, entry.encoding) for entry in Recording(path).messages())
    return [message.sequence for message in found if isinstance(message, Sample)]
