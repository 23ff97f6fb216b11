"""A chunk never costs more memory than it claims and the setting allows: it is refused in one line."""

import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, Header, McapRecord, Message
from mcap.writer import MCAP0_MAGIC

from reactorwatch.errors import InputError
from recorder.files.copies import Window, cut, recover
from recorder.files.index import LARGEST_MB, LATEST_NS
from recorder.files.recording import Recording
from recorder.tools.inspect import inspect

BOMB_BYTES = 40_000_000
KEY = "reactor/cstr/sample/T"
PACKED = {"zstd": zstandard.compress, "lz4": lz4.frame.compress, "": bytes}


def bytes_of(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def message(number: int) -> bytes:
    return bytes_of(Message(channel_id=1, sequence=number, log_time=number, publish_time=number, data=b"x" * 20))


DESCRIBED = bytes_of(Channel(id=1, topic=KEY, message_encoding="x", metadata={}, schema_id=0))


def chunk(
    data: bytes, compression: str = "zstd", first_ns: int = 1, last_ns: int = 2, claimed: int | None = None
) -> Chunk:
    return Chunk(
        compression=compression,
        data=PACKED[compression](data),
        message_start_time=first_ns,
        message_end_time=last_ns,
        uncompressed_crc=zlib.crc32(data),
        uncompressed_size=len(data) if claimed is None else claimed,
    )


def recording(chunks: list[Chunk], indexed_bytes: int | None = None, *, indexed: bool = True) -> bytes:
    """A file of these chunks; the index claims another size of the last one, if it is given."""
    content = MCAP0_MAGIC + bytes_of(Header(profile="", library=""))
    indexes = []
    for item in chunks:
        record = bytes_of(item)
        size = item.uncompressed_size
        indexes.append(
            ChunkIndex(
                chunk_length=len(record),
                chunk_start_offset=len(content),
                compression=item.compression,
                compressed_size=len(item.data),
                message_end_time=item.message_end_time,
                message_index_length=0,
                message_index_offsets={1: len(content)},
                message_start_time=item.message_start_time,
                uncompressed_size=size if item is not chunks[-1] or indexed_bytes is None else indexed_bytes,
            )
        )
        content += record
    content += bytes_of(DataEnd(0))
    start = len(content)
    if indexed:
        content += DESCRIBED + bytes_of(*indexes)
    footer = Footer(summary_start=start if indexed else 0, summary_offset_start=0, summary_crc=0)
    return content + bytes_of(footer) + MCAP0_MAGIC


SOUND = chunk(DESCRIBED + message(1) + message(2))
WIDE = chunk(DESCRIBED + message(1) + message(9), last_ns=9), chunk(message(5), first_ns=5, last_ns=5)
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
READERS: dict[str, Callable[[Path, Path], object]] = {
    "read": lambda path, _: list(Recording(path).messages()),
    "cut": lambda path, out: cut([path], out, Window((0, LATEST_NS)), {}),
}


@pytest.fixture(scope="module")
def bombs() -> dict[tuple[str, str], tuple[Chunk, int | None]]:
    return {(name, packing): make(packing) for name, make in BOMBS.items() for packing in ("zstd", "lz4")}


@pytest.mark.parametrize("packing", ["zstd", "lz4"])
@pytest.mark.parametrize("name", BOMBS)
def test_every_reader_refuses_it_in_one_line_and_takes_no_more_memory_than_is_allowed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    bombs: dict[tuple[str, str], tuple[Chunk, int | None]],
    name: str,
    packing: str,
) -> None:
    monkeypatch.setenv(LARGEST_MB, "1")
    bomb, indexed_bytes = bombs[name, packing]
    files = {"indexed": recording([SOUND, bomb], indexed_bytes)}
    if indexed_bytes is None:
        files["unindexed"] = recording([SOUND, bomb], indexed=False)
        files["out of order"] = recording([chunk(DESCRIBED + message(9), first_ns=9, last_ns=9), bomb])
    path, out = tmp_path / "run.mcap", tmp_path / "out.mcap"
    for content in files.values():
        path.write_bytes(content)
        tracemalloc.start()
        for read in READERS.values():
            with pytest.raises(InputError, match=r"^[^\n]*run\.mcap[^\n]*$"):
                read(path, out)
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


@pytest.mark.parametrize("packing", PACKED)
def test_a_chunk_within_the_limit_is_read_whole(tmp_path: Path, packing: str) -> None:
    data = DESCRIBED + b"".join(map(message, range(1, 200)))
    for indexed in (True, False):
        path = tmp_path / f"{indexed}.mcap"
        path.write_bytes(recording([chunk(data, packing)], indexed=indexed))
        assert [entry.log_time_ns for entry in Recording(path).messages()] == list(range(1, 200))


def test_chunks_that_overlap_give_their_messages_in_the_order_of_receipt(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    for indexed in (True, False):
        path.write_bytes(recording(list(WIDE), indexed=indexed))
        assert [entry.log_time_ns for entry in Recording(path).messages()] == [1, 5, 9]


@pytest.mark.parametrize("text", ["", "0", "-1", "much", "nan", "inf"])
def test_a_limit_that_makes_no_sense_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv(LARGEST_MB, text)
    path = tmp_path / "run.mcap"
    path.write_bytes(recording([SOUND]))
    with pytest.raises(InputError, match=f"{LARGEST_MB} must be a positive number, got '{text}'"):
        list(Recording(path).messages())
