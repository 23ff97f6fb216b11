"""Damaged recordings: one clear line, never a traceback, never a wrong message, and never more memory than allowed.

The index of a recording is read where it is whole, and its damage is named.

Damaged recordings: one clear line, never a traceback, and never a wrong message.

A chunk never costs more memory than it claims and the setting allows: it is refused in one line.
"""

import struct
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from mcap.records import (
    Chunk,
    Metadata,
    MetadataIndex,
)
from mcap.summary import Summary

from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError
from recorder import RecordedMessage
from recorder.files.copies import Window, cut, recover
from recorder.files.index import (
    LARGEST_MB,
    LATEST_NS,
    RECORD,
    TABLE_CURE,
    decompress,
    largest_chunk_bytes,
)
from recorder.files.reader import Reader, metadata_records
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter
from recorder.tools.convert import read_record
from recorder.tools.inspect import inspect, zero_ns_of
from tests.unit.recorder import golden
from tests.unit.recorder.mcap_bytes import DESCRIBED, PACKED, SOUND, bytes_of, chunk, message, recording
from tests.unit.recorder.recording import recorded

FOOTER_BYTES, MAGIC_BYTES = 29, 8


@pytest.mark.parametrize(("text", "expected"), [(None, 32_000_000), ("1", 1_000_000), ("0.5", 500_000), ("1e-6", 1)])
def test_the_largest_chunk_is_set_by_the_environment(
    monkeypatch: pytest.MonkeyPatch, text: str | None, expected: int
) -> None:
    monkeypatch.delenv(LARGEST_MB, raising=False)
    if text is not None:
        monkeypatch.setenv(LARGEST_MB, text)
    assert largest_chunk_bytes() == expected


def test_a_chunk_is_decompressed_up_to_the_largest_size_and_to_what_it_claims(monkeypatch: pytest.MonkeyPatch) -> None:
    data = DESCRIBED + message(1)
    monkeypatch.setenv(LARGEST_MB, f"{len(data) / 1e6:f}")
    for packing in ("", "zstd", "lz4"):
        assert decompress(chunk(data, packing), None) == decompress(chunk(data, packing), len(data)) == data
        for claimed, text in (
            (len(data) - 1, f"holds more than the {len(data) - 1} bytes that it claims"),
            (len(data) + 1, "claims to hold 0.0 MB, and at most"),
        ):
            with pytest.raises(ValueError, match=text):
                decompress(chunk(data, packing, claimed=claimed), None)
    with pytest.raises(ValueError, match=f"claims to hold {len(data)} bytes, and the index 7"):
        decompress(chunk(data), 7)
    monkeypatch.delenv(LARGEST_MB)
    with pytest.raises(ValueError, match=f"holds {len(data)} bytes, and claims {len(data) + 1}"):
        decompress(chunk(data, claimed=len(data) + 1), None)


def changed(item: Chunk, **fields: object) -> Chunk:
    """A chunk with other fields."""
    for name, value in fields.items():
        setattr(item, name, value)
    return item


def test_the_content_of_a_chunk_is_checked() -> None:
    data = DESCRIBED + message(1)
    assert decompress(changed(chunk(data), uncompressed_crc=0), None) == data, "0: there is no checksum"
    assert decompress(chunk(b""), None) == b""
    assert decompress(chunk(b"\x80 private"), None) == b"\x80 private"
    for item, text in (
        (changed(chunk(data), uncompressed_crc=7), "the checksum of the chunk differs"),
        (changed(chunk(data), compression="gzip"), "compression must be zstd, lz4 or none, got 'gzip'"),
        (chunk(b"\x08 an index"), "begins with a record of kind 8, which no chunk may hold"),
        (chunk(b"\x7f"), "begins with a record of kind 127"),
    ):
        with pytest.raises(ValueError, match=text):
            decompress(item, None)


def changed_at(content: bytes, at: int, value: bytes) -> bytes:
    """Content with other bytes somewhere."""
    at %= len(content)
    return content[:at] + value + content[at + len(value) :]


INTACT = recording([SOUND])
FOOTER_AT = len(INTACT) - MAGIC_BYTES - FOOTER_BYTES
SUMMARY_AT = INTACT.rindex(DESCRIBED)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "got an empty file"),
        (b"time_min,T\n0,1\n" * 9, f"expected an MCAP recording, got another kind of file; {TABLE_CURE}"),
        (b"PK\x03\x04", f"expected an MCAP recording, got another kind of file; {TABLE_CURE}"),
        (INTACT[:5], "is cut off;"),
        (INTACT[:44], "is cut off;"),
        (INTACT[:-1], "is cut off: the recorder was killed, or is still writing it"),
        (changed_at(INTACT, -1, b"?"), "is cut off: the recorder was killed"),
        (changed_at(INTACT, SUMMARY_AT + 1, b"\xff"), "its index is damaged ("),
        (changed_at(INTACT, FOOTER_AT, b"\x03"), "is cut off: the recorder was killed"),
        (changed_at(INTACT, FOOTER_AT + 1, b"\x15"), "is cut off: the recorder was killed"),
        (changed_at(INTACT, FOOTER_AT + 9, (FOOTER_AT + 1).to_bytes(8, "little")), "its index is damaged;"),
        (changed_at(INTACT, FOOTER_AT + 25, b"\x01"), "its index is damaged: the checksum differs"),
    ],
)
def test_a_file_without_a_whole_index_is_refused_with_what_is_wrong(tmp_path: Path, content: bytes, text: str) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError) as raised:
        Reader(path)
    assert text in str(raised.value)
    assert str(raised.value).startswith(f"{path}: ")


def test_a_file_without_an_index_has_an_empty_one_and_one_that_ends_at_its_footer_too(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(recording([SOUND], indexed=False))
    assert vars(Reader(path).summary) == vars(Summary())
    path.write_bytes(changed_at(INTACT, FOOTER_AT + 9, FOOTER_AT.to_bytes(8, "little")))
    assert vars(Reader(path).summary) == vars(Summary())
    path.write_bytes(INTACT[:MAGIC_BYTES] + changed_at(INTACT, FOOTER_AT + 9, bytes(8))[FOOTER_AT:])
    assert vars(Reader(path).summary) == vars(Summary()), "the shortest file"
    path.write_bytes(INTACT)
    found = Reader(path).summary
    assert (list(found.channels), len(found.chunk_indexes)) == ([1], 1)


def test_metadata_are_read_where_the_index_names_them_and_another_record_there_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, {"seed": "3"}) as writer:
        writer.write(RecordedMessage("T", b"x", "text", 1, 1))
        writer.add_metadata("notes", {"text": "a"})
    reader = Reader(path)
    reader.read_indexed_metadata()
    records = reader.metadata
    assert [record.name for record in records] == ["reactorwatch", "notes"]
    assert records == metadata_records(path)
    (first, *_) = reader.summary.metadata_indexes
    header = MetadataIndex(length=first.length, name="notes", offset=MAGIC_BYTES)
    reader.summary.metadata_indexes = [header]
    with pytest.raises(InputError, match="its metadata cannot be read"):
        reader.read_indexed_metadata()
    record = bytes_of(Metadata(name="notes", metadata={"text": "a"}))
    reader.summary.metadata_indexes = [MetadataIndex(length=len(record), name="notes", offset=first.offset + 3)]
    with pytest.raises(InputError, match="its metadata cannot be read"):
        reader.read_indexed_metadata()


SAMPLES = [entry for entry in golden.entries() if "/sample/" in entry.key][:60]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A recording of three chunks."""
    return recorded(tmp_path_factory.mktemp("whole") / "run.mcap", SAMPLES, 20).read_bytes()


def read_or_refuse(path: Path) -> list[RecordedMessage] | str:
    """Messages of a file, or the error that refuses it."""
    try:
        return list(Recording(path).messages())
    except InputError as error:
        return str(error)


def reads_as(path: Path, contents: Iterator[bytes]) -> list[list[RecordedMessage] | str]:
    found = []
    for content in contents:
        path.write_bytes(content)
        found.append(read_or_refuse(path))
    return found


def test_a_file_that_is_cut_off_anywhere_is_known_as_such(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    for stated in reads_as(path, (whole[:length] for length in range(8, len(whole), 7))):
        assert isinstance(stated, str)
        assert stated.startswith(f"{path}: is cut off")
        assert f"`reactorwatch recover {path}`" in stated


def test_a_byte_that_is_wrong_is_found_or_does_no_harm(tmp_path: Path, whole: bytes) -> None:
    def wrong() -> Iterator[bytes]:
        for place in range(0, len(whole), 3):
            yield whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :]

    results = reads_as(tmp_path / "run.mcap", wrong())
    assert all(isinstance(result, str) or result == SAMPLES for result in results)
    stated = "\n".join(result for result in results if isinstance(result, str))
    assert "another kind of file" in stated
    assert "is cut off" in stated
    assert "its index is damaged" in stated
    assert "the chunk at byte" in stated
    assert len(stated.splitlines()) == sum(isinstance(result, str) for result in results)


def test_a_chunk_of_zeros_names_its_place_and_keeps_what_came_before(tmp_path: Path, whole: bytes) -> None:
    path = tmp_path / "run.mcap"
    at = whole.index(b"\x28\xb5\x2f\xfd", whole.index(b"\x28\xb5\x2f\xfd") + 1)  # second frame of zstd
    path.write_bytes(whole[:at] + bytes(50) + whole[at + 50 :])
    messages = Recording(path).messages()
    assert [next(messages) for _ in range(20)] == SAMPLES[:20]
    with pytest.raises(InputError, match=r"the chunk at byte \d+ cannot be read .*recover"):
        next(messages)


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


def test_damaged_metadata_of_a_later_file_stop_only_what_needs_those_of_all_files(tmp_path: Path) -> None:
    for number, entries in enumerate((SAMPLES[:30], SAMPLES[30:])):
        recorded(tmp_path / f"run-{number}.mcap", entries, metadata={"plant": "cstr"})
    later = tmp_path / "run-1.mcap"
    (item,) = Reader(later).summary.metadata_indexes
    content = bytearray(later.read_bytes())
    struct.pack_into("<I", content, item.offset + RECORD.size, 2**31 - 1)  # length of the record's name
    later.write_bytes(content)
    recording = Recording(tmp_path)
    assert recording.metadata["plant"] == "cstr"
    assert zero_ns_of(recording) == SAMPLES[0].publish_time_ns
    assert read_record(tmp_path, process=find_process("cstr")).rows
    for all_files in ("metadata_records", "metadata_by_file"):
        with pytest.raises(InputError, match=f"^{later}: its metadata cannot be read"):
            getattr(recording, all_files)


BOMB_BYTES = 40_000_000
ZEROS = bytes(BOMB_BYTES)
MESSAGES = DESCRIBED + message(3) * (BOMB_BYTES // len(message(3)))

BOMBS: dict[str, Callable[[str], tuple[Chunk, int | None]]] = {
    "more than is allowed": lambda packing: (chunk(MESSAGES, packing), None),
    "more than it claims": lambda packing: (chunk(MESSAGES, packing, claimed=1000), None),
    "zeros": lambda packing: (chunk(ZEROS, packing), None),
    "zeros, and it claims few": lambda packing: (chunk(ZEROS, packing, claimed=1000), None),
    "zeros that are allowed": lambda packing: (chunk(bytes(900_000), packing), None),
    "less than it claims": lambda packing: (chunk(message(3), packing, claimed=900_000), None),
    "not what the index claims": lambda packing: (chunk(message(3), packing), 7),
}


@pytest.mark.parametrize("packing", ["zstd", "lz4"])
@pytest.mark.parametrize("name", BOMBS)
def test_every_reader_refuses_it_in_one_line_and_takes_no_more_memory_than_is_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, packing: str
) -> None:
    """Every command reads by one of these."""
    monkeypatch.setenv(LARGEST_MB, "1")
    bomb, indexed_bytes = BOMBS[name](packing)
    files = {"indexed": recording([SOUND, bomb], indexed_bytes)}
    if indexed_bytes is None:
        files["unindexed"] = recording([SOUND, bomb], indexed=False)
        files["out of order"] = recording([chunk(DESCRIBED + message(9), first_ns=9, last_ns=9), bomb])
    path, out = tmp_path / "run.mcap", tmp_path / "out.mcap"
    for content in files.values():
        path.write_bytes(content)
        tracemalloc.start()
        with pytest.raises(InputError, match=r"^[^\n]*run\.mcap[^\n]*$"):
            list(Recording(path).messages())
        with pytest.raises(InputError, match=r"^[^\n]*run\.mcap[^\n]*$"):
            cut([path], out, Window((0, LATEST_NS)), {})
        assert not out.exists()
        seen = inspect(path)
        saved = recover(path, out)
        peak_bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert saved.messages == sum(topic.count for topic in seen.overview.topics.values())
        assert 1 <= saved.messages <= 2
        assert len(seen.damages) == 1
        assert "\n" not in seen.damages[0]
        assert peak_bytes < 6 * 10**6 + 4 * len(content)
        out.unlink()


def test_a_chunk_among_the_records_of_the_index_and_in_place_of_metadata_is_not_decompressed(tmp_path: Path) -> None:
    path, bomb = tmp_path / "run.mcap", chunk(ZEROS)
    whole = recording([SOUND, bomb])
    named = MetadataIndex(offset=whole.index(bytes_of(bomb)), length=len(bytes_of(bomb)), name="reactorwatch")
    tracemalloc.start()
    path.write_bytes(recording([SOUND], further=bytes_of(bomb)))
    assert len(list(Recording(path).messages())) == 2
    path.write_bytes(recording([SOUND, bomb], further=bytes_of(named)))
    with pytest.raises(InputError, match=r"run\.mcap: its metadata cannot be read"):
        _ = Recording(path).metadata
    assert tracemalloc.get_traced_memory()[1] < BOMB_BYTES / 4
    tracemalloc.stop()


@pytest.mark.parametrize("packing", PACKED)
def test_a_chunk_within_the_limit_is_read_whole(tmp_path: Path, packing: str) -> None:
    data = DESCRIBED + b"".join(map(message, range(1, 200)))
    for indexed in (True, False):
        path = tmp_path / f"{indexed}.mcap"
        path.write_bytes(recording([chunk(data, packing)], indexed=indexed))
        assert [entry.log_time_ns for entry in Recording(path).messages()] == list(range(1, 200))


@pytest.mark.parametrize("text", ["", "0", "-1", "much", "nan", "inf"])
def test_a_limit_that_makes_no_sense_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv(LARGEST_MB, text)
    path = tmp_path / "run.mcap"
    path.write_bytes(recording([SOUND]))
    with pytest.raises(InputError, match=f"{LARGEST_MB} must be a positive number, got '{text}'"):
        list(Recording(path).messages())
