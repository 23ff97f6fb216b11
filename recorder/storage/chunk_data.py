"""Bounded decompression of MCAP chunks.

A chunk of a few kilobytes may decompress to gigabytes. So its claimed size is checked first, and no more than one byte
beyond it is decompressed.
"""

import os
import zlib

import lz4.frame
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk

LARGEST_MB = "REACTORWATCH_LARGEST_CHUNK_MB"
"""Environment variable that sets the largest chunk that is read."""
DEFAULT_LARGEST_MB = 32.0

_MB = 1_000_000
_RECORDS = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE})
FIRST_PRIVATE = 0x80
"""Opcodes from here on are private to other programs; their records are skipped."""


def largest_chunk_bytes() -> int:
    """Largest chunk that is read, from the environment.

    Raises:
        ValueError: the variable is not a positive number.
    """
    text = os.environ.get(LARGEST_MB, str(DEFAULT_LARGEST_MB))
    try:
        largest_mb = float(text)
    except ValueError:
        largest_mb = -1.0
    if not 0.0 < largest_mb < float("inf"):
        raise ValueError(f"{LARGEST_MB} must be a positive number, got {text!r}")
    return round(largest_mb * _MB)


def chunk_data(chunk: Chunk, indexed_bytes: int | None = None) -> bytes:
    """Decompressed records of a chunk.

    Args:
        chunk: chunk record of the file.
        indexed_bytes: uncompressed size in the file's index; None if there is no index.

    Raises:
        ValueError: it is larger than the setting allows, not of the size that is claimed, or damaged. Errors of the
            decompressor are passed on.
    """
    claimed, largest = chunk.uncompressed_size, largest_chunk_bytes()
    if claimed > largest:
        raise ValueError(
            f"the chunk claims to hold {claimed / _MB:.1f} MB, and at most {largest / _MB:g} MB are read; "
            f"{LARGEST_MB} sets another limit"
        )
    if indexed_bytes is not None and indexed_bytes != claimed:
        raise ValueError(f"the chunk claims to hold {claimed} bytes, and the index {indexed_bytes}")
    data = _decompress(chunk, claimed)
    if len(data) > claimed:
        raise ValueError(f"the chunk holds more than the {claimed} bytes that it claims")
    if len(data) < claimed:
        raise ValueError(f"the chunk holds {len(data)} bytes, and claims {claimed}")
    if data and data[0] not in _RECORDS and data[0] < FIRST_PRIVATE:
        raise ValueError(f"the chunk begins with a record of kind {data[0]}, which no chunk may hold")
    crc = chunk.uncompressed_crc
    if crc and zlib.crc32(data) != crc:
        raise ValueError("the checksum of the chunk differs")
    return data


def _decompress(chunk: Chunk, claimed: int) -> bytes:
    """Content of a chunk; of one that holds more than it claims, at most a byte beyond that."""
    match chunk.compression:
        case "zstd":
            with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
                return reader.read(claimed + 1)
        case "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, claimed + 1))
        case "":
            return chunk.data
        case other:
            raise ValueError(f"compression must be zstd, lz4 or none, got {other!r}")
