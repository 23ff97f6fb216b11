"""The file being written: a full disk at any byte loses no message that is reported as saved, and none is there twice.

A full disk at any byte: no message reported as saved is lost, none is there twice, and flushing resumes.

Drained bytes are in the file, synced ones on the disk, and the lock lasts as long as the recorder.
"""

import contextlib
import errno
import fcntl
import os
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.records import Attachment

from reactorwatch.contract.codec import encoding_of
from reactorwatch.contract.messages_pb2 import QUALITY_GOOD, Sample
from reactorwatch.errors import InputError
from recorder import RecordedMessage
from recorder.files.copies import recover
from recorder.files.reader import Reader, metadata_records
from recorder.files.recording import Recording
from recorder.files.writer import (
    PART,
    PartFile,
    RecordingWriter,
    StoredChannel,
    WriteError,
    check_free,
    is_locked,
    lock_orphan,
)
from tests.unit.recorder import golden
from tests.unit.recorder.recording import Disk

ENTRIES = list(golden.entries())[:30]
FIRST, SECOND = ENTRIES[:15], ENTRIES[15:]


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


def test_a_recording_that_cannot_be_started_leaves_no_file(tmp_path: Path) -> None:
    disk, path = Disk(20), tmp_path / "run.mcap"
    with pytest.raises(WriteError) as raised:
        RecordingWriter(path, {}, disk.open)
    assert str(raised.value) == f"recording {path}: cannot be written: No space left on device"
    assert raised.value.reason == "No space left on device"
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_can_no_longer_be_written_names_the_file_that_it_left(tmp_path: Path) -> None:
    disk, writer, part = start_second_chunk(tmp_path)
    disk.room = 0
    with pytest.raises(WriteError) as raised:
        writer.flush()
    assert str(raised.value).endswith(f"cannot be written: No space left on device; what was written is in {part}")
    writer.abandon()


def test_the_start_of_a_recording_is_in_its_file_at_once_and_messages_after_a_flush(tmp_path: Path) -> None:
    path, part = tmp_path / "run.mcap", tmp_path / "run.mcap.part"
    writer = RecordingWriter(path, {"seed": "3"})
    (record,) = metadata_records(part)
    assert (record.name, record.metadata["seed"]) == ("reactorwatch", "3")
    started_bytes = writer.size_bytes
    assert started_bytes == part.stat().st_size
    writer.write(ENTRIES[0])
    assert intact_messages(part) == []
    assert writer.abandon() == 0, "its chunk was not written"
    assert not path.exists()


def test_a_recording_is_renamed_when_it_is_closed_and_a_second_close_does_nothing(tmp_path: Path) -> None:
    path, part = tmp_path / "run.mcap", tmp_path / "run.mcap.part"
    with RecordingWriter(path, {}) as writer:
        writer.write(ENTRIES[0])
        writer.add_metadata("notes", {"text": "a"})
        assert writer.size_bytes == writer._stream.tell()
    assert (path.exists(), part.exists()) == (True, False)
    content = path.read_bytes()
    writer.close()
    assert writer.abandon() == 0
    assert path.read_bytes() == content
    assert [record.name for record in metadata_records(path)] == ["reactorwatch", "notes"]


def test_a_sample_has_its_number_modulo_2_to_the_32_and_anything_else_has_0(tmp_path: Path) -> None:
    sample = Sample(sequence=2**33 - 2, time_ns=1, quality=QUALITY_GOOD)
    message = RecordedMessage("reactor/cstr/sample/T", sample.SerializeToString(), encoding_of(Sample), 1, 1)
    with RecordingWriter(tmp_path / "run.mcap", {}) as writer:
        writer.write(message)
        writer.write(message._replace(payload=b"\xff\xff"))
        writer.write(message._replace(encoding="text"))
    found = [
        (stored.sequence, isinstance(stored.channel, StoredChannel) and stored.channel.schema is not None)
        for stored in Reader(tmp_path / "run.mcap")
    ]
    assert found == [(2**32 - 2, True), (0, False), (0, False)]


def test_a_recording_has_a_channel_for_each_key_encoding_and_use_and_one_schema_for_each_type(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, {}) as writer:
        for message in ENTRIES:
            writer.write(message)
            writer.write(message._replace(latched=True))
    summary = Reader(path).summary
    keys = {(entry.key, entry.encoding) for entry in ENTRIES}
    assert len(summary.channels) == 2 * len(keys)
    assert len(summary.schemas) == len({schema.name for schema in summary.schemas.values()})
    copy = tmp_path / "copy.mcap"
    with RecordingWriter(copy, {}) as writer:
        for _ in range(2):  # two readers have objects of their own for equal channels
            for stored in Reader(path):
                writer.append(stored)
    copied = Reader(copy).summary
    assert (len(copied.channels), len(copied.schemas)) == (len(summary.channels), len(summary.schemas))
    assert [stored.recorded_message for stored in Reader(copy)] == 2 * [
        stored.recorded_message for stored in Reader(path)
    ]


def test_a_file_has_room_for_a_number_of_keys_and_the_next_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recorder.files.writer.MAX_CHANNELS", 2)
    with RecordingWriter(tmp_path / "run.mcap", {}) as writer:
        for key in ("a", "b"):
            writer.write(RecordedMessage(key, b"x", "text", 1, 1))
        with pytest.raises(WriteError, match="a file has room for 2 keys, and 'c' is one more") as raised:
            writer.write(RecordedMessage("c", b"x", "text", 1, 1))
        assert raised.value.reason == "a file has room for 2 keys, and 'c' is one more"
        writer.write(RecordedMessage("a", b"y", "text", 2, 2))
    assert [stored.payload for stored in Reader(tmp_path / "run.mcap")] == [b"x", b"x", b"y"]


def test_a_recording_of_a_name_that_is_taken_is_refused_with_the_cure(tmp_path: Path) -> None:
    path, part = tmp_path / "run.mcap", tmp_path / "run.mcap.part"
    check_free(path)
    with pytest.raises(InputError, match=r"the folder .* does not exist"):
        check_free(tmp_path / "none" / "run.mcap")
    with RecordingWriter(path, {}), pytest.raises(InputError, match="is being written by another recorder"):
        check_free(path)
    with pytest.raises(InputError, match="exists already and is not overwritten"):
        check_free(path)
    path.rename(part)
    with pytest.raises(InputError, match=f"`reactorwatch recover {part}` saves what is whole in it"):
        check_free(path)


def test_messages_before_an_attachment_are_in_the_file_ahead_of_it(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap", {})
    writer.write(ENTRIES[0])
    writer.add_attachment(Attachment(create_time=1, log_time=1, name="a", media_type="text/plain", data=b"x"))
    assert intact_messages(tmp_path / "run.mcap.part") == [ENTRIES[0]]
    writer.close()
    reader = Reader(tmp_path / "run.mcap")
    assert len(list(reader)) == 1
    assert [item.name for item in reader.attachments()] == ["a"]


DATA = b"x" * 1000


def open_part(folder: Path) -> PartFile:
    """A new file in a folder."""
    return PartFile(folder / f"run.mcap{PART}")


@contextlib.contextmanager
def abandoned(file: PartFile) -> Iterator[PartFile]:
    """A file that is abandoned at the end."""
    try:
        yield file
    finally:
        file.abandon()


@pytest.mark.parametrize(
    "act", [PartFile.sync, lambda file: file.finish(file.path.with_suffix(""))], ids=["sync", "finish"]
)
def test_the_system_is_asked_to_write_all_bytes_to_the_disk(
    act: Callable[[PartFile], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = list[tuple[int, bool, int]]()
    path = tmp_path / f"run.mcap{PART}"
    file = PartFile(path)
    number = path.stat().st_ino

    def record(descriptor: int) -> None:
        status = os.fstat(descriptor)
        synced.append((status.st_ino, path.exists(), status.st_size))

    monkeypatch.setattr(os, "fsync", record)
    file.write(DATA)
    act(file)
    file.abandon()
    assert synced == [(number, True, len(DATA))]


def test_a_file_that_cannot_be_renamed_is_closed_under_its_old_name(tmp_path: Path) -> None:
    file = open_part(tmp_path)
    file.write(DATA)
    with pytest.raises(FileNotFoundError):
        file.finish(tmp_path / "none" / "run.mcap")
    assert (file.closed, file.path.read_bytes(), is_locked(file.path)) == (True, DATA, False)


def test_an_orphan_that_another_file_replaced_while_it_was_locked_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"run.mcap{PART}"
    path.write_bytes(DATA)
    lock = fcntl.flock

    def replace(*arguments: Any) -> None:
        lock(*arguments)
        path.unlink()
        path.write_bytes(b"")

    monkeypatch.setattr(fcntl, "flock", replace)
    with pytest.raises(FileNotFoundError, match="is another file by now"), lock_orphan(path):
        pass
    assert not is_locked(path)
