"""A full disk at any byte: no message reported as saved is lost, none is there twice, and flushing resumes."""

import errno
import os
import traceback
from collections.abc import Callable
from pathlib import Path

import pytest
from mcap.reader import make_reader

from recorder import RecordedMessage
from recorder.files.copies import recover
from recorder.files.part_file import PartFile
from recorder.files.reader import Reader
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter, WriteError
from tests.unit.recorder import golden

ENTRIES = list(golden.entries())[:30]
FIRST, SECOND = ENTRIES[:15], ENTRIES[15:]


class Disk:
    """Disk with a room in bytes; a write may be taken in part."""

    room = 10**9

    def open(self, path: Path) -> PartFile:
        disk = self

        class OnDisk(PartFile):
            def _append(self, data: bytearray) -> int:
                if not disk.room:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                taken = super()._append(data[: disk.room])
                disk.room -= taken
                return taken

        return OnDisk(path)


def start_second_chunk(folder: Path) -> tuple[Disk, RecordingWriter, Path]:
    """Recording with one flushed chunk and the messages of a second one."""
    disk, path = Disk(), folder / "run.mcap"
    writer = RecordingWriter(path, {}, disk.open)
    for entry in FIRST:
        writer.write(entry)
    writer.flush()
    for entry in SECOND:
        writer.write(entry)
    return disk, writer, folder / "run.mcap.part"


def intact_messages(part: Path) -> list[RecordedMessage]:
    return [stored.recorded_message for stored in Reader(part, tolerant=True)]


def second_chunk_bytes(folder: Path) -> int:
    _, writer, part = start_second_chunk(folder)
    flushed_bytes = part.stat().st_size
    writer.flush()
    second_bytes = part.stat().st_size - flushed_bytes
    writer.abandon()
    part.unlink()
    return second_bytes


def test_a_disk_that_is_full_at_any_byte_of_a_chunk_keeps_exactly_the_messages_that_are_counted(tmp_path: Path) -> None:
    size_bytes = second_chunk_bytes(tmp_path)
    counts = []
    for room in range(size_bytes):
        disk, writer, part = start_second_chunk(tmp_path)
        disk.room = room
        with pytest.raises(WriteError, match="No space left on device"):
            writer.flush()
        saved = writer.abandon()
        assert intact_messages(part) == FIRST + SECOND[:saved], room
        counts.append(saved)
        part.unlink()
    assert counts == sorted(counts)
    assert set(counts) == {0, len(SECOND)}  # all of it where only its index has no room


def test_a_flush_that_failed_at_any_byte_resumes_where_it_stopped(tmp_path: Path) -> None:
    size_bytes = second_chunk_bytes(tmp_path)
    for room in range(size_bytes):
        disk, writer, part = start_second_chunk(tmp_path)
        disk.room = room
        with pytest.raises(WriteError):
            writer.flush()
        disk.room = 10**9
        writer.flush()
        writer.abandon()
        assert intact_messages(part) == ENTRIES, room
        part.unlink()


def test_a_chunk_that_fills_up_is_handed_over_at_once_and_counted_if_the_disk_is_full(tmp_path: Path) -> None:
    """Chunks of a mebibyte that no flush ended."""
    disk, path = Disk(), tmp_path / "run.mcap"
    writer = RecordingWriter(path, {}, disk.open)
    disk.room = 1_500_000
    written = [RecordedMessage("x", os.urandom(100_000), "", number, number) for number in range(1, 40)]

    def write_all() -> None:
        for message in written:
            writer.write(message)

    with pytest.raises(WriteError):
        write_all()
    saved = writer.abandon()
    assert 0 < saved < len(written)
    recover(tmp_path / "run.mcap.part", tmp_path / "out.mcap")
    assert list(Recording(tmp_path / "out.mcap").messages()) == written[:saved]


@pytest.mark.parametrize("act", [RecordingWriter.flush, RecordingWriter.sync, RecordingWriter.close])
def test_the_library_meets_no_error_of_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, act: Callable[[RecordingWriter], None]
) -> None:
    disk, writer, _ = start_second_chunk(tmp_path)
    disk.room = 0
    inside = list[bool]()

    def drain(self: PartFile) -> None:
        inside.append(any(f"{os.sep}mcap{os.sep}" in frame.filename for frame in traceback.extract_stack()))
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(PartFile, "drain", drain)
    with pytest.raises(WriteError):
        act(writer)
    writer.abandon()
    assert inside
    assert not any(inside)


def test_the_library_reads_a_recording_and_its_statistics_agree(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, {"plant": "cstr"}) as writer:
        for number, entry in enumerate(ENTRIES):
            writer.write(entry)
            if number % 7 == 6:
                writer.flush()
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found = [(channel.topic, message.data) for _, channel, message in reader.iter_messages(log_time_order=False)]
        summary = reader.get_summary()
    assert found == [(entry.key, entry.payload) for entry in ENTRIES]
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(ENTRIES)
    assert summary.statistics.chunk_count == -(-len(ENTRIES) // 7)
