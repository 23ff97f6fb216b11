"""Index at the end of an MCAP file, and the content of its chunks.

The library parses single records only: its readers decompress every chunk that they meet, whatever its size. A chunk
of a few kilobytes may decompress to gigabytes. So here its claimed size is checked first, and no more than one byte
beyond it is decompressed.
"""

import io
import mmap
import os
import struct
import zlib
from pathlib import Path

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, MetadataIndex, Schema, Statistics
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from reactorwatch.errors import InputError

LATEST_NS = 2**64 - 1
LARGEST_MB = "REACTORWATCH_LARGEST_CHUNK_MB"
"""Environment variable that sets the largest chunk that is read; 32 MB are several times what any writer makes."""
TABLE_CURE = "the name of a table must end in .csv, .xlsx, .parquet or another ending of a table"
"""Cure for a table that is taken for a recording by its name."""
FOOTER = struct.Struct("<BQQQI")
"""Opcode, length, start of the summary, start of the summary offsets, checksum."""
RECORD = struct.Struct("<BQ")
"""Opcode and length of a record."""
FIRST_PRIVATE = 0x80
"""Opcodes from here on are private to other programs."""

_IN_CHUNKS = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE})

DAMAGE = (
    McapError,
    struct.error,
    zstandard.ZstdError,
    ValueError,
    KeyError,
    IndexError,
    MemoryError,
    OverflowError,
    RuntimeError,
)
"""Errors that the library and its dependencies raise for damaged bytes."""


def read_summary(path: Path, data: mmap.mmap) -> Summary:
    """Index at the end of a file; empty if the file has none, which the format allows.

    Args:
        path: the file, for errors.
        data: content of the file.

    Raises:
        InputError: it is no MCAP file, is cut off, or its index is damaged.
    """
    size, magic = len(data), data[: len(MCAP0_MAGIC)]
    if magic != MCAP0_MAGIC[: len(magic)]:
        raise foreign_file_error(path)
    tail = FOOTER.size + len(MCAP0_MAGIC)
    if size < len(MCAP0_MAGIC) + tail:
        raise damage_error(path, "is cut off")
    opcode, length, start, _, crc = FOOTER.unpack_from(data, size - tail)
    if data[-len(MCAP0_MAGIC) :] != MCAP0_MAGIC or opcode != Opcode.FOOTER or length != FOOTER.size - RECORD.size:
        raise damage_error(path, "is cut off: the recorder was killed, or is still writing it")
    if not start:
        return Summary()
    if start > size - tail:
        raise damage_error(path, "its index is damaged")
    content = data[start:]
    if crc and zlib.crc32(content[: -len(MCAP0_MAGIC) - 4]) != crc:
        raise damage_error(path, "its index is damaged: the checksum differs")
    summary = Summary()
    reader = StreamReader(io.BytesIO(content), skip_magic=True, emit_chunks=True, record_size_limit=len(content))
    try:
        for record in reader.records:  # other kinds, such as chunks, are ignored
            match record:
                case Schema():
                    summary.schemas[record.id] = record
                case Channel():
                    summary.channels[record.id] = record
                case ChunkIndex():
                    summary.chunk_indexes.append(record)
                case MetadataIndex():
                    summary.metadata_indexes.append(record)
                case Statistics():
                    summary.statistics = record
    except DAMAGE as error:
        raise damage_error(path, "its index is damaged", error) from error
    return summary


def is_indexed(summary: Summary) -> bool:
    """True if the file has chunks, and all of them and their channels are in the index."""
    chunks = summary.chunk_indexes
    known = {number for number, channel in summary.channels.items() if channel.schema_id in {0, *summary.schemas}}
    return bool(chunks) and all(
        chunk.message_index_offsets and known.issuperset(chunk.message_index_offsets) for chunk in chunks
    )


def span_ns(summary: Summary) -> tuple[int, int]:
    """Times of receipt of the first and of the last message.

    Returns:
        (0, 0) for a file without messages; (0, 2^64 - 1) if the index has no times.
    """
    if summary.statistics is not None:
        return summary.statistics.message_start_time, summary.statistics.message_end_time
    chunks = summary.chunk_indexes
    if not chunks:
        return 0, LATEST_NS
    return min(chunk.message_start_time for chunk in chunks), max(chunk.message_end_time for chunk in chunks)


def largest_chunk_bytes() -> int:
    """Largest chunk that is read, from the environment.

    Raises:
        ValueError: the variable is not a positive number.
    """
    text = os.environ.get(LARGEST_MB, "32")
    try:
        largest_mb = float(text)
    except ValueError:
        largest_mb = -1.0
    if not 0.0 < largest_mb < float("inf"):
        raise ValueError(f"{LARGEST_MB} must be a positive number, got {text!r}")
    return round(largest_mb * 1e6)


def decompress(chunk: Chunk, indexed_bytes: int | None) -> bytes:
    """Decompressed records of a chunk, of which the index claims `indexed_bytes`; None: there is no index.

    Raises:
        ValueError: it is larger than the setting allows, not of the size that is claimed, or damaged. Errors of the
            decompressor are passed on.
    """
    claimed, largest = chunk.uncompressed_size, largest_chunk_bytes()
    if claimed > largest:
        raise ValueError(
            f"the chunk claims to hold {claimed / 1e6:.1f} MB, and at most {largest / 1e6:g} MB are read; "
            f"{LARGEST_MB} sets another limit"
        )
    if indexed_bytes is not None and indexed_bytes != claimed:
        raise ValueError(f"the chunk claims to hold {claimed} bytes, and the index {indexed_bytes}")
    match chunk.compression:
        case "zstd":
            with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
                data = reader.read(claimed + 1)
        case "lz4":
            data = bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, claimed + 1))
        case "":
            data = chunk.data
        case other:
            raise ValueError(f"compression must be zstd, lz4 or none, got {other!r}")
    if len(data) > claimed:
        raise ValueError(f"the chunk holds more than the {claimed} bytes that it claims")
    if len(data) < claimed:
        raise ValueError(f"the chunk holds {len(data)} bytes, and claims {claimed}")
    if data and data[0] not in _IN_CHUNKS and data[0] < FIRST_PRIVATE:
        raise ValueError(f"the chunk begins with a record of kind {data[0]}, which no chunk may hold")
    crc = chunk.uncompressed_crc
    if crc and zlib.crc32(data) != crc:
        raise ValueError("the checksum of the chunk differs")
    return data


def foreign_file_error(path: Path) -> InputError:
    """Error for a file that is no recording."""
    return InputError(f"{path}: expected an MCAP recording, got another kind of file; {TABLE_CURE}")


def damage_error(path: Path, what: str, error: Exception | None = None) -> InputError:
    """Error for a damaged file, with the command that recovers it."""
    why = f" ({str(error) or type(error).__name__})" if error else ""
    return InputError(f"{path}: {what}{why}; `reactorwatch recover {path}` saves what is whole in it")
