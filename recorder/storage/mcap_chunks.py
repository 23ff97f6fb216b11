"""Reader of the index and the chunks of an MCAP file; damage raises a one-line error.

Messages are parsed here (`_messages_of`) and not by the library, which builds an object for each record. They are
sorted only where the file needs it: messages out of the order of receipt, as files of other programs may have it. Files
without chunks or without an index are left to `mcap_scan`.
"""

import heapq
import io
import itertools
import struct
import zlib
from collections.abc import Iterator, Mapping
from operator import attrgetter
from pathlib import Path
from typing import IO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, ChunkIndex, Metadata, Schema
from mcap.summary import Summary
from mcap.well_known import MessageEncoding
from mcap.writer import MCAP0_MAGIC

from reactorwatch.contract.codec import PREFIX
from reactorwatch.errors import InputError
from reactorwatch.records.input_file import wrap_read_errors
from recorder.message import RecordedMessage
from recorder.storage.chunk_data import chunk_data

FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary, of the summary offsets, CRC
RECORD = struct.Struct("<BQ")  # opcode, length
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the payload
_MESSAGE_RECORD = struct.Struct("<BQHIQQ")  # both
_MESSAGE_OPCODE = int(Opcode.MESSAGE)

TABLE_CURE = "the name of a table must end in .csv, .xlsx, .parquet or another ending of a table"
"""Cure for a table that is taken for a recording by its name."""

LATCHED = "reactorwatch.repeated"
"""Key in the metadata of a channel of latched messages, see `RecordedMessage.latched`."""

# raised for damaged bytes by the library and its dependencies
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


def read_summary(path: Path) -> Summary:
    """Index at the end of the file; empty if the file has none, which the format allows.

    Raises:
        InputError: the file does not exist, is no MCAP file, is cut off, or its index is damaged.
    """
    with wrap_read_errors(path):
        size = path.stat().st_size
        stream = path.open("rb")
    with stream:
        magic = stream.read(len(MCAP0_MAGIC))
        if not magic:
            raise InputError(f"{path}: expected an MCAP recording, got an empty file")
        if magic != MCAP0_MAGIC[: len(magic)]:
            raise foreign_file_error(path)
        tail = FOOTER.size + len(MCAP0_MAGIC)
        if size < len(MCAP0_MAGIC) + tail:
            raise damage_error(path, "is cut off")
        stream.seek(-tail, 2)
        end = stream.read()
        opcode, length, start, _, crc = FOOTER.unpack_from(end)
        if not end.endswith(MCAP0_MAGIC) or opcode != Opcode.FOOTER or length != FOOTER.size - RECORD.size:
            raise damage_error(path, "is cut off: the recorder was killed, or is still writing it")
        if not start:
            return Summary()
        if start > size - tail:
            raise damage_error(path, "its index is damaged")
        stream.seek(start)
        summary = stream.read(size - tail - start) + end[: FOOTER.size - 4]
        if crc and zlib.crc32(summary) != crc:
            raise damage_error(path, "its index is damaged: the checksum differs")
        stream.seek(0)
        try:
            return SeekingReader(stream, record_size_limit=size).get_summary() or Summary()
        except DAMAGE as error:
            raise damage_error(path, "its index is damaged", error) from error


def is_in_order(summary: Summary) -> bool:
    """True if the chunks are in the order of receipt without overlap."""
    return all(a.message_end_time <= b.message_start_time for a, b in itertools.pairwise(_chunks(summary)))


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
        return 0, 2**64 - 1
    return min(chunk.message_start_time for chunk in chunks), max(chunk.message_end_time for chunk in chunks)


def ordered_messages(path: Path, summary: Summary, wanted: set[int]) -> Iterator[RecordedMessage]:
    """Messages of the wanted channels in the order of receipt, of a file that `is_indexed` and `is_in_order`.

    Raises:
        InputError: a chunk is damaged; raised when the iteration reaches it.
    """
    channels = {number: keyed_channel(summary.channels[number], summary.schemas) for number in wanted}
    size = path.stat().st_size
    with path.open("rb") as stream:
        for index in _chunks(summary):
            if wanted.isdisjoint(index.message_index_offsets):
                continue
            try:
                parsed = _messages_of(_decompress_chunk(stream, index, size), channels)
            except DAMAGE as error:
                where = f"the chunk at byte {index.chunk_start_offset} cannot be read"
                raise damage_error(path, where, error) from error
            parsed.sort(key=attrgetter("log_time_ns"))  # stable, and fast if sorted already
            yield from parsed


def sorted_messages(path: Path, summary: Summary) -> Iterator[RecordedMessage]:
    """All messages in the order of receipt, of a file that `is_indexed`; a chunk is read when its first message is due.

    Raises:
        InputError: the file is damaged; raised when the iteration reaches the damage.
    """
    channels = {number: keyed_channel(channel, summary.schemas) for number, channel in summary.channels.items()}
    # log time, chunk, position in it: unique, so that no two messages are compared
    waiting: list[tuple[int, int, int, RecordedMessage]] = []
    size = path.stat().st_size
    with path.open("rb") as stream:
        for index in sorted(summary.chunk_indexes, key=attrgetter("message_start_time", "chunk_start_offset")):
            while waiting and waiting[0][0] < index.message_start_time:
                yield heapq.heappop(waiting)[-1]
            try:
                parsed = _messages_of(_decompress_chunk(stream, index, size), channels, all_described=True)
            except DAMAGE as error:
                raise damage_error(path, "cannot be read", error) from error
            for position, message in enumerate(parsed):
                heapq.heappush(waiting, (message.log_time_ns, index.chunk_start_offset, position, message))
    while waiting:
        yield heapq.heappop(waiting)[-1]


def metadata_records(path: Path) -> list[Metadata]:
    """Metadata records of a file.

    Raises:
        InputError: as `read_summary`.
    """
    read_summary(path)
    with path.open("rb") as stream:
        try:
            return list(SeekingReader(stream, record_size_limit=path.stat().st_size).iter_metadata())
        except DAMAGE as error:
            raise damage_error(path, "its metadata cannot be read", error) from error


def _chunks(summary: Summary) -> list[ChunkIndex]:
    return sorted(summary.chunk_indexes, key=attrgetter("chunk_start_offset"))


class KeyedChannel(NamedTuple):
    """Fields that all messages of a channel share; see `RecordedMessage`."""

    key: str
    encoding: str
    latched: bool


def keyed_channel(channel: Channel, schemas: Mapping[int, Schema]) -> KeyedChannel:
    """Key, encoding and latched flag of a channel record.

    Raises:
        KeyError: its schema is not in `schemas`.
    """
    encoding = channel.message_encoding
    if encoding == MessageEncoding.Protobuf and channel.schema_id:
        encoding = PREFIX + schemas[channel.schema_id].name
    return KeyedChannel(channel.topic, encoding, LATCHED in channel.metadata)


def _decompress_chunk(stream: IO[bytes], index: ChunkIndex, size: int) -> bytes:
    if index.chunk_start_offset + index.chunk_length > size:
        raise ValueError("it reaches beyond the end of the file")
    stream.seek(index.chunk_start_offset + RECORD.size)
    record = stream.read(index.chunk_length - RECORD.size)  # no more, whatever lengths the chunk claims
    return chunk_data(Chunk.read(ReadDataStream(io.BytesIO(record))), index.uncompressed_size)


def _messages_of(
    data: bytes, channels: Mapping[int, KeyedChannel], *, all_described: bool = False
) -> list[RecordedMessage]:
    """Messages of an uncompressed chunk, a sequence of records of opcode, length and content.

    Args:
        data: the chunk.
        channels: channels by number; messages of other channels are skipped.
        all_described: True if there are no other channels, so that a message of one is damage.

    Raises:
        ValueError: a record is of an unknown kind, or its channel is not described.
    """
    found: list[RecordedMessage] = []
    append, new, unpack = found.append, tuple.__new__, _MESSAGE_RECORD.unpack_from  # this runs for each message
    at, end = 0, len(data)
    while at < end:
        opcode = data[at]
        if opcode == _MESSAGE_OPCODE:
            _, length, number, _, log_time, publish_time = unpack(data, at)
            channel = channels.get(number)
            if channel is not None:
                key, encoding, latched = channel
                payload = data[at + _MESSAGE_RECORD.size : at + RECORD.size + length]
                append(new(RecordedMessage, (key, payload, encoding, log_time, publish_time, latched)))
            elif all_described:
                raise ValueError(f"channel {number} is described nowhere")
        elif opcode:
            _, length = RECORD.unpack_from(data, at)
        else:
            raise ValueError("the chunk holds a record of kind 0, which the format does not know")
        at += RECORD.size + length
    return found


def foreign_file_error(path: Path) -> InputError:
    """Error for a file that is no recording."""
    return InputError(f"{path}: expected an MCAP recording, got another kind of file; {TABLE_CURE}")


def damage_error(path: Path, what: str, error: Exception | None = None) -> InputError:
    """Error for a damaged file, with the command that recovers it."""
    why = f" ({str(error) or type(error).__name__})" if error else ""
    return InputError(f"{path}: {what}{why}; `reactorwatch recover {path}` saves what is whole in it")
