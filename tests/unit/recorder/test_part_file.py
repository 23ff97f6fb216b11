"""Drained bytes are in the file, synced ones on the disk, and the lock lasts as long as the recorder."""

import contextlib
import errno
import fcntl
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from reactorwatch.errors import InputError
from recorder.files.part_file import PART, PartFile, is_locked, lock_orphan, open_recording

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


def test_bytes_are_buffered_until_they_are_drained_and_dropped_when_the_file_is_abandoned(tmp_path: Path) -> None:
    path = tmp_path / f"run.mcap{PART}"
    file = PartFile(path)
    assert file.write(b"abc") == 3
    file.flush()
    assert (file.tell(), file.drained, path.stat().st_size) == (3, 0, 0)
    file.drain()
    assert (file.tell(), file.drained, path.read_bytes()) == (3, 3, b"abc")
    file.write(b"de")
    assert (file.tell(), file.closed) == (5, False)
    file.abandon()
    assert (file.tell(), file.closed, path.read_bytes()) == (3, True, b"abc")
    file.abandon()


def test_the_end_of_the_last_chunk_is_known_when_its_record_is_written(tmp_path: Path) -> None:
    with abandoned(open_part(tmp_path)) as file:
        file.write(b"\x05 a message")
        assert file.chunk_end == 0
        file.write(b"\x06 a chunk")
        file.drain()
        file.write(b"\x07 an index")
        assert (file.chunk_end, file.tell()) == (20, 30)
        file.write(b"\x06 another")
        assert file.chunk_end == file.tell() == 39


@pytest.mark.parametrize("taken", [1, 3, 1000])
def test_a_write_that_takes_part_of_the_buffer_is_continued(
    tmp_path: Path, taken: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    append = PartFile._append
    monkeypatch.setattr(PartFile, "_append", lambda file, data: append(file, data[:taken]))
    with abandoned(open_part(tmp_path)) as file:
        file.write(b"0123456789")
        file.drain()
        assert (file.drained, file.path.read_bytes()) == (10, b"0123456789")


@pytest.mark.parametrize("instead", ["nothing", "another file", "a file at the place of its folder"])
def test_a_file_that_was_deleted_is_reported_when_bytes_are_drained(tmp_path: Path, instead: str) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    with abandoned(open_part(folder)) as file:
        file.write(DATA)
        file.path.unlink()
        if instead == "another file":
            file.path.write_bytes(DATA)
        elif instead != "nothing":
            folder.rmdir()
            folder.write_bytes(b"")
        with pytest.raises(OSError, match="its file was deleted") as raised:
            file.drain()
        assert raised.value.errno == errno.ENOENT


def test_a_finished_file_has_its_complete_name_and_no_lock(tmp_path: Path) -> None:
    file, complete = open_part(tmp_path), tmp_path / "run.mcap"
    file.write(DATA)
    assert is_locked(file.path)
    file.finish(complete)
    assert (file.closed, file.path.exists(), complete.read_bytes()) == (True, False, DATA)
    assert not is_locked(complete)
    assert not is_locked(file.path), "it does not exist"


def test_a_file_that_cannot_be_renamed_is_closed_under_its_old_name(tmp_path: Path) -> None:
    file = open_part(tmp_path)
    file.write(DATA)
    with pytest.raises(FileNotFoundError):
        file.finish(tmp_path / "none" / "run.mcap")
    assert (file.closed, file.path.read_bytes(), is_locked(file.path)) == (True, DATA, False)


def test_an_orphan_is_locked_by_one_process_at_a_time_and_by_none_while_it_is_written(tmp_path: Path) -> None:
    file = open_part(tmp_path)
    with pytest.raises(InputError, match="is still being written; stop its recorder first"), lock_orphan(file.path):
        pass
    file.write(DATA)
    file.drain()
    file.abandon()
    with lock_orphan(file.path) as stream:
        assert stream.read() == DATA
        assert is_locked(file.path)
    assert not is_locked(file.path)


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


def test_a_file_that_its_recorder_completed_meanwhile_is_opened_under_its_complete_name(tmp_path: Path) -> None:
    complete, part = tmp_path / "run.mcap", tmp_path / f"run.mcap{PART}"
    complete.write_bytes(DATA)
    for path in (complete, part):
        with open_recording(path) as stream:
            assert stream.read() == DATA
    part.write_bytes(b"part")
    with open_recording(part) as stream:
        assert stream.read() == b"part"
    for missing in (tmp_path / "none.mcap", tmp_path / f"none.mcap{PART}"):
        with pytest.raises(FileNotFoundError):
            open_recording(missing)
