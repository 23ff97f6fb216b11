"""Recordings built record by record, as other programs may write them."""

import zlib

import lz4.frame
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Channel, Chunk, ChunkIndex, DataEnd, Footer, Header, McapRecord, Message
from mcap.writer import MCAP0_MAGIC

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


def index_of(chunk: Chunk, record: bytes, at: int) -> ChunkIndex:
    """Index of a chunk whose record is at a byte of a file, with messages of channel 1."""
    return ChunkIndex(
        chunk_length=len(record),
        chunk_start_offset=at,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        message_end_time=chunk.message_end_time,
        message_index_length=0,
        message_index_offsets={1: at},
        message_start_time=chunk.message_start_time,
        uncompressed_size=chunk.uncompressed_size,
    )


def recording(
    chunks: list[Chunk], indexed_bytes: int | None = None, *, indexed: bool = True, further: bytes = b""
) -> bytes:
    """A file of these chunks; the index may claim another size of the last one, and have further records."""
    content = MCAP0_MAGIC + bytes_of(Header(profile="", library=""))
    indexes = []
    for item in chunks:
        record = bytes_of(item)
        indexes.append(index_of(item, record, len(content)))
        if item is chunks[-1] and indexed_bytes is not None:
            indexes[-1].uncompressed_size = indexed_bytes
        content += record
    content += bytes_of(DataEnd(0))
    start = len(content)
    if indexed:
        content += DESCRIBED + bytes_of(*indexes) + further
    footer = Footer(summary_start=start if indexed else 0, summary_offset_start=0, summary_crc=0)
    return content + bytes_of(footer) + MCAP0_MAGIC


SOUND = chunk(DESCRIBED + message(1) + message(2))
