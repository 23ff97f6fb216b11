"""The index of a recording is read where it is whole, and its damage is named."""

from pathlib import Path

import pytest
from mcap.records import Channel, Chunk, ChunkIndex, Metadata, MetadataIndex, Schema, Statistics
from mcap.summary import Summary

from reactorwatch.errors import InputError
from recorder import RecordedMessage
from recorder.files.index import (
    DEFAULT_LARGEST_MB,
    LARGEST_MB,
    LATEST_NS,
    decompress,
    is_indexed,
    largest_chunk_bytes,
    read_indexed_metadata,
    read_summary,
    span_ns,
)
from recorder.files.reader import metadata_records
from recorder.files.writer import RecordingWriter
from tests.unit.recorder.test_chunk_data import DESCRIBED, SOUND, bytes_of, chunk, message, recording

FOOTER_BYTES, MAGIC_BYTES = 29, 8


def indexed(first_ns: int, last_ns: int, channels: tuple[int, ...] = (1,)) -> ChunkIndex:
    """Index of a chunk with messages of these channels."""
    return ChunkIndex(
        chunk_length=0,
        chunk_start_offset=0,
        compression="",
        compressed_size=0,
        message_end_time=last_ns,
        message_index_length=0,
        message_index_offsets=dict.fromkeys(channels, 0),
        message_start_time=first_ns,
        uncompressed_size=0,
    )


def summary(*chunks: ChunkIndex, schema: int = 0, schemas: tuple[int, ...] = ()) -> Summary:
    """An index of these chunks and of channel 1."""
    found = Summary()
    found.chunk_indexes = list(chunks)
    found.channels = {1: Channel(id=1, topic="T", message_encoding="x", metadata={}, schema_id=schema)}
    found.schemas = {number: Schema(id=number, name="x", encoding="x", data=b"") for number in schemas}
    return found


def test_the_span_is_that_of_the_statistics_or_of_the_chunks() -> None:
    found = summary(indexed(5, 9), indexed(3, 8))
    assert span_ns(found) == (3, 9)
    found.statistics = Statistics(
        attachment_count=0, channel_count=1, channel_message_counts={}, chunk_count=2, message_count=2,
        message_end_time=7, message_start_time=4, metadata_count=0, schema_count=0,
    )  # fmt: skip
    assert span_ns(found) == (4, 7)
    assert span_ns(Summary()) == (0, LATEST_NS)
    assert LATEST_NS == 2**64 - 1


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (Summary(), False),
        (summary(), False),
        (summary(indexed(1, 2)), True),
        (summary(indexed(1, 2), indexed(3, 4, ())), False),
        (summary(indexed(1, 2), indexed(3, 4, (1, 2))), False),
        (summary(indexed(1, 2), schema=3), False),
        (summary(indexed(1, 2), schema=3, schemas=(3,)), True),
    ],
    ids=["empty", "no chunk", "whole", "chunk without index", "channel missing", "schema missing", "schema"],
)
def test_a_file_is_indexed_if_its_chunks_and_their_channels_and_schemas_are(found: Summary, *, expected: bool) -> None:
    assert is_indexed(found) is expected


@pytest.mark.parametrize(("text", "expected"), [("1", 1_000_000), ("0.5", 500_000), ("1e-6", 1)])
def test_the_largest_chunk_is_set_by_the_environment(monkeypatch: pytest.MonkeyPatch, text: str, expected: int) -> None:
    monkeypatch.delenv(LARGEST_MB, raising=False)
    assert largest_chunk_bytes() == DEFAULT_LARGEST_MB * 1_000_000 == 32_000_000
    monkeypatch.setenv(LARGEST_MB, text)
    assert largest_chunk_bytes() == expected


@pytest.mark.parametrize("text", ["0", "-1", "inf", "nan", "much", ""])
def test_a_largest_chunk_that_is_no_positive_number_is_refused(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv(LARGEST_MB, text)
    with pytest.raises(ValueError, match=f"must be a positive number, got '{text}'"):
        largest_chunk_bytes()


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


WHOLE = recording([SOUND])
FOOTER_AT = len(WHOLE) - MAGIC_BYTES - FOOTER_BYTES
SUMMARY_AT = WHOLE.rindex(DESCRIBED)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "got an empty file"),
        (b"time_min,T\n0,1\n" * 9, "expected an MCAP recording, got another kind of file"),
        (WHOLE[:5], "is cut off;"),
        (WHOLE[:44], "is cut off;"),
        (WHOLE[:-1], "is cut off: the recorder was killed, or is still writing it"),
        (changed_at(WHOLE, -1, b"?"), "is cut off: the recorder was killed"),
        (changed_at(WHOLE, SUMMARY_AT + 1, b"\xff"), "its index is damaged ("),
        (changed_at(WHOLE, FOOTER_AT, b"\x03"), "is cut off: the recorder was killed"),
        (changed_at(WHOLE, FOOTER_AT + 1, b"\x15"), "is cut off: the recorder was killed"),
        (changed_at(WHOLE, FOOTER_AT + 9, (FOOTER_AT + 1).to_bytes(8, "little")), "its index is damaged;"),
        (changed_at(WHOLE, FOOTER_AT + 25, b"\x01"), "its index is damaged: the checksum differs"),
    ],
)
def test_a_file_without_a_whole_index_is_refused_with_what_is_wrong(tmp_path: Path, content: bytes, text: str) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError) as raised:
        read_summary(path)
    assert text in str(raised.value)
    assert str(raised.value).startswith(f"{path}: ")


def test_a_file_without_an_index_has_an_empty_one_and_one_that_ends_at_its_footer_too(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(recording([SOUND], indexed=False))
    assert vars(read_summary(path)) == vars(Summary())
    path.write_bytes(changed_at(WHOLE, FOOTER_AT + 9, FOOTER_AT.to_bytes(8, "little")))
    assert vars(read_summary(path)) == vars(Summary())
    path.write_bytes(WHOLE[:MAGIC_BYTES] + changed_at(WHOLE, FOOTER_AT + 9, bytes(8))[FOOTER_AT:])
    assert vars(read_summary(path)) == vars(Summary()), "the shortest file"
    path.write_bytes(WHOLE)
    found = read_summary(path)
    assert (list(found.channels), len(found.chunk_indexes)) == ([1], 1)


def test_metadata_are_read_where_the_index_names_them_and_another_record_there_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, {"seed": "3"}) as writer:
        writer.write(RecordedMessage("T", b"x", "text", 1, 1))
        writer.add_metadata("notes", {"text": "a"})
    found = read_summary(path)
    records = read_indexed_metadata(path, found)
    assert [record.name for record in records] == ["reactorwatch", "notes"]
    assert records == metadata_records(path)
    (first, *_) = found.metadata_indexes
    header = MetadataIndex(length=first.length, name="notes", offset=MAGIC_BYTES)
    damaged = Summary()
    damaged.metadata_indexes = [header]
    with pytest.raises(InputError, match="its metadata cannot be read"):
        read_indexed_metadata(path, damaged)
    record = bytes_of(Metadata(name="notes", metadata={"text": "a"}))
    damaged.metadata_indexes = [MetadataIndex(length=len(record), name="notes", offset=first.offset + 3)]
    with pytest.raises(InputError, match="its metadata cannot be read"):
        read_indexed_metadata(path, damaged)
