"""Damaged recordings: one clear line, never a traceback, and never a wrong message."""

import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError
from recorder import RecordedMessage
from recorder.files.index import FOOTER, RECORD, TABLE_CURE
from recorder.files.reader import Reader
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter
from recorder.tools.convert import read_record
from recorder.tools.inspect import zero_ns_of
from tests.unit.recorder import golden

ENTRIES = [entry for entry in golden.entries() if "/sample/" in entry.key][:60]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A recording of three chunks."""
    path = tmp_path_factory.mktemp("whole") / "run.mcap"
    with RecordingWriter(path, {}) as writer:
        for number, entry in enumerate(ENTRIES):
            writer.write(entry)
            if number % 20 == 19:
                writer.flush()
    return path.read_bytes()


def read(path: Path) -> list[RecordedMessage] | str:
    """What is in a file, or the line that says why it cannot be told."""
    try:
        return list(Recording(path).messages())
    except InputError as error:
        return str(error)


def reads_as(path: Path, contents: Iterator[bytes]) -> list[list[RecordedMessage] | str]:
    found = []
    for content in contents:
        path.write_bytes(content)
        found.append(read(path))
    return found


def test_a_file_that_is_cut_off_anywhere_is_known_as_such(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    for said in reads_as(path, (whole[:length] for length in range(8, len(whole), 7))):
        assert isinstance(said, str)
        assert said.startswith(f"{path}: is cut off")
        assert f"`reactorwatch recover {path}`" in said


def test_a_byte_that_is_wrong_is_found_or_does_no_harm(tmp_path: Path, whole: bytes) -> None:
    def wrong() -> Iterator[bytes]:
        for place in range(0, len(whole), 3):
            yield whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :]

    results = reads_as(tmp_path / "run.mcap", wrong())
    assert all(isinstance(result, str) or result == ENTRIES for result in results)
    said = "\n".join(result for result in results if isinstance(result, str))
    assert "another kind of file" in said
    assert "is cut off" in said
    assert "its index is damaged" in said
    assert "the chunk at byte" in said
    assert len(said.splitlines()) == sum(isinstance(result, str) for result in results)


def test_a_chunk_of_zeros_names_its_place_and_keeps_what_came_before(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    at = whole.index(b"\x28\xb5\x2f\xfd", whole.index(b"\x28\xb5\x2f\xfd") + 1)  # second frame of zstd
    path.write_bytes(whole[:at] + bytes(50) + whole[at + 50 :])
    messages = Recording(path).messages()
    assert [next(messages) for _ in range(20)] == ENTRIES[:20]
    with pytest.raises(InputError, match=r"the chunk at byte \d+ cannot be read .*recover"):
        next(messages)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "expected an MCAP recording, got an empty file"),
        (b"time_min,qc,C,T\n", f"expected an MCAP recording, got another kind of file; {TABLE_CURE}"),
        (b"PK\x03\x04", f"expected an MCAP recording, got another kind of file; {TABLE_CURE}"),
    ],
)
def test_a_file_that_is_no_recording_is_reported_as_such_and_offers_no_rescue(
    tmp_path: Path, content: bytes, said: str
) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    assert read(path) == f"{path}: {said}"


def test_every_way_of_reading_reports_the_same_error_at_the_call(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(whole[:-1])
    for reading in (Recording, read_record):
        with pytest.raises(InputError, match="is cut off"):
            reading(path)
        with pytest.raises(InputError, match="there is no such file"):
            reading(tmp_path / "none.mcap")
        with pytest.raises(InputError, match=r"run\.mcap: is cut off"):
            reading(tmp_path)  # a folder is read as the recordings in it


def without_checksum(content: bytes) -> bytearray:
    """The same file, whose index has no checksum, as the format allows."""
    changed = bytearray(content)
    changed[-12:-8] = bytes(4)
    return changed


def test_an_index_without_a_checksum_that_cannot_be_parsed_is_named(whole: bytes, tmp_path: Path) -> None:
    path, content = tmp_path / "run.mcap", without_checksum(whole)
    start = FOOTER.unpack_from(content, len(content) - FOOTER.size - 8)[2]
    opcode, _ = RECORD.unpack_from(content, start)
    RECORD.pack_into(content, start, opcode, 2**40)
    path.write_bytes(content)
    said = read(path)
    assert isinstance(said, str)
    assert said.startswith(f"{path}: its index is damaged (")


@pytest.mark.parametrize("length", [10, 10_000])
def test_an_index_that_names_another_record_as_metadata_is_named(whole: bytes, tmp_path: Path, length: int) -> None:
    """The record is longer than the index says, or of another kind."""
    path, content = tmp_path / "run.mcap", without_checksum(whole)
    path.write_bytes(content)
    (item,) = Reader(path).summary.metadata_indexes
    header = struct.pack("<QQ", 8, length)
    path.write_bytes(bytes(content).replace(struct.pack("<QQ", item.offset, item.length), header))
    with pytest.raises(InputError, match="its metadata cannot be read"):
        _ = Recording(path).metadata


def test_damaged_metadata_of_a_later_file_stop_only_what_needs_those_of_all_files(tmp_path: Path) -> None:
    for number, entries in enumerate((ENTRIES[:30], ENTRIES[30:])):
        with RecordingWriter(tmp_path / f"run-{number}.mcap", {"plant": "cstr"}) as writer:
            for entry in entries:
                writer.write(entry)
    later = tmp_path / "run-1.mcap"
    (item,) = Reader(later).summary.metadata_indexes
    content = bytearray(later.read_bytes())
    struct.pack_into("<I", content, item.offset + RECORD.size, 2**31 - 1)  # length of the record's name
    later.write_bytes(content)
    recording = Recording(tmp_path)
    assert recording.metadata["plant"] == "cstr"
    assert zero_ns_of(recording) == ENTRIES[0].publish_time_ns
    assert read_record(tmp_path, process=find_process("cstr")).rows
    for all_files in ("metadata_records", "metadata_by_file"):
        with pytest.raises(InputError, match=f"^{later}: its metadata cannot be read"):
            getattr(recording, all_files)
