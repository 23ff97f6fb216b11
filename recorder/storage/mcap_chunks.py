"""The index and the chunks of an MCAP file, read so that damage is told in one line.

The message records are taken out of a chunk here (`_messages_of`) and not by the library, which builds an object for
each and, in order of receipt, sorts them all. That is left to it only where a file needs it: its messages are not in
the order of receipt, or it has no chunks or no index, as other programs may write it.
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
from mcap.records import Channel, Chunk, ChunkIndex, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.summary import Summary
from mcap.well_known import MessageEncoding
from mcap.writer import MCAP0_MAGIC

from reactorwatch.contract.codec import PREFIX
from reactorwatch.errors import InputError
from reactorwatch.records.input_file import wrap_read_errors
from recorder.message import Entry
from recorder.storage.chunk_data import chunk_data

FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary, of the summary offsets, CRC
RECORD = struct.Struct("<BQ")  # opcode, length
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the payload

REPEATED = "reactorwatch.repeated"
"""In the metadata of a channel: its messages are said again, see `Entry.repeated`."""

# what reading damaged bytes raises, in the library and in what it stands on
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
    """The index at the end of the file; empty if the file has none, which the format allows.

    Raises:
        InputError: the file is not there, is no MCAP file, is cut off, or its index is damaged.
    """
    with wrap_read_errors(path):
        size = path.stat().st_size
        stream = path.open("rb")
    with stream:
        magic = stream.read(len(MCAP0_MAGIC))
        if not magic:
            raise InputError(f"{path}: expected an MCAP recording, got an empty file")
        if magic != MCAP0_MAGIC[: len(magic)]:
            raise InputError(f"{path}: expected an MCAP recording, got another kind of file")
        tail = FOOTER.size + len(MCAP0_MAGIC)
        if size < len(MCAP0_MAGIC) + tail:
            raise damaged(path, "is cut off")
        stream.seek(-tail, 2)
        end = stream.read()
        opcode, length, start, _, crc = FOOTER.unpack_from(end)
        if not end.endswith(MCAP0_MAGIC) or opcode != Opcode.FOOTER or length != FOOTER.size - RECORD.size:
            raise damaged(path, "is cut off: the recorder was killed, or is still writing it")
        if not start:
            return Summary()
        if start > size - tail:
            raise damaged(path, "its index is damaged")
        stream.seek(start)
        summary = stream.read(size - tail - start) + end[: FOOTER.size - 4]
        if crc and zlib.crc32(summary) != crc:
            raise damaged(path, "its index is damaged: the checksum differs")
        stream.seek(0)
        try:
            return SeekingReader(stream, record_size_limit=size).get_summary() or Summary()
        except DAMAGE as error:
            raise damaged(path, "its index is damaged", error) from error


def is_in_order(summary: Summary) -> bool:
    """Whether the index knows all that is in the chunks, and these follow each other in time."""
    chunks = _chunks(summary)
    follow = all(a.message_end_time <= b.message_start_time for a, b in itertools.pairwise(chunks))
    return _is_indexed(summary) and follow


def span_ns(summary: Summary) -> tuple[int, int]:
    """The times of receipt of the first and of the last message.

    Returns:
        Both 0 for a file without messages; from 0 to the end of time for one whose index does not say.
    """
    if summary.statistics is not None:
        return summary.statistics.message_start_time, summary.statistics.message_end_time
    chunks = summary.chunk_indexes
    if not chunks:
        return 0, 2**64 - 1
    return min(chunk.message_start_time for chunk in chunks), max(chunk.message_end_time for chunk in chunks)


def entries(path: Path, summary: Summary, wanted: set[int]) -> Iterator[Entry]:
    """The messages of the wanted channels, of a file that is in order.

    Raises:
        InputError: a chunk is damaged; when the reading comes there.
    """
    channels = {number: channel_of(summary.channels[number], summary.schemas) for number in wanted}
    size = path.stat().st_size
    with path.open("rb") as stream:
        for index in _chunks(summary):
            if wanted.isdisjoint(index.message_index_offsets):
                continue
            try:
                data = _uncompressed(stream, index, size)
                found = list(_messages_of(data, channels))
            except DAMAGE as error:
                where = f"the chunk at byte {index.chunk_start_offset} cannot be read"
                raise damaged(path, where, error) from error
            found.sort(key=attrgetter("log_time_ns"))  # stable, and quick when there is nothing to do
            yield from found


def sorted_entries(path: Path, summary: Summary) -> Iterator[Entry]:
    """All messages of any MCAP file, in the order of receipt. Without an index all of them are in memory at once.

    Raises:
        InputError: the file is damaged; when the reading comes there.
    """
    with path.open("rb") as stream:
        try:
            if _is_indexed(summary):
                yield from _sorted_chunks(stream, summary, path.stat().st_size)
            else:
                yield from sorted(_walk(stream, path.stat().st_size), key=attrgetter("log_time_ns"))
        except DAMAGE as error:
            raise damaged(path, "cannot be read", error) from error


def _sorted_chunks(stream: IO[bytes], summary: Summary, size: int) -> Iterator[Entry]:
    """The messages of chunks that overlap, each chunk read when the first of its messages is due."""
    channels = {number: channel_of(channel, summary.schemas) for number, channel in summary.channels.items()}
    waiting: list[tuple[int, int, int, Entry]] = []  # log time, chunk and number in it; so no two entries are compared
    for index in sorted(summary.chunk_indexes, key=attrgetter("message_start_time", "chunk_start_offset")):
        while waiting and waiting[0][0] < index.message_start_time:
            yield heapq.heappop(waiting)[-1]
        found = _messages_of(_uncompressed(stream, index, size), channels, dict(summary.schemas))
        for number, entry in enumerate(found):
            heapq.heappush(waiting, (entry.log_time_ns, index.chunk_start_offset, number, entry))
    while waiting:
        yield heapq.heappop(waiting)[-1]


def _walk(stream: IO[bytes], size: int) -> Iterator[Entry]:
    """The messages of a file without an index, from its front to its end."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, KeyedChannel] = {}
    reader = StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=size)
    for record in reader.records:
        match record:
            case Chunk():
                yield from _messages_of(chunk_data(record), channels, schemas)
            case Schema():
                schemas[record.id] = record
            case Channel():
                channels[record.id] = channel_of(record, schemas)
            case Message():
                channel = channels[record.channel_id]
                times = record.log_time, record.publish_time
                yield Entry(channel.key, record.data, channel.encoding, *times, channel.repeated)


def metadata_records(path: Path) -> list[Metadata]:
    """What programs have written into the file about it.

    Raises:
        InputError: as `read_summary`.
    """
    read_summary(path)
    with path.open("rb") as stream:
        try:
            return list(SeekingReader(stream, record_size_limit=path.stat().st_size).iter_metadata())
        except DAMAGE as error:
            raise damaged(path, "its metadata cannot be read", error) from error


def _chunks(summary: Summary) -> list[ChunkIndex]:
    return sorted(summary.chunk_indexes, key=attrgetter("chunk_start_offset"))


def _is_indexed(summary: Summary) -> bool:
    chunks = summary.chunk_indexes
    known = {number for number, channel in summary.channels.items() if channel.schema_id in {0, *summary.schemas}}
    return bool(chunks) and all(
        chunk.message_index_offsets and known.issuperset(chunk.message_index_offsets) for chunk in chunks
    )


class KeyedChannel(NamedTuple):
    """What the messages of a channel have in common; see `Entry`."""

    key: str
    encoding: str
    repeated: bool


def channel_of(channel: Channel, schemas: Mapping[int, Schema]) -> KeyedChannel:
    """What a channel record says.

    Raises:
        KeyError: its schema is not among those given.
    """
    encoding = channel.message_encoding
    if encoding == MessageEncoding.Protobuf and channel.schema_id:
        encoding = PREFIX + schemas[channel.schema_id].name
    return KeyedChannel(channel.topic, encoding, REPEATED in channel.metadata)


def _uncompressed(stream: IO[bytes], index: ChunkIndex, size: int) -> bytes:
    if index.chunk_start_offset + index.chunk_length > size:
        raise ValueError("it reaches beyond the end of the file")
    stream.seek(index.chunk_start_offset + RECORD.size)
    record = stream.read(index.chunk_length - RECORD.size)  # no more, whatever lengths the chunk claims
    return chunk_data(Chunk.read(ReadDataStream(io.BytesIO(record))), index.uncompressed_size)


def _messages_of(
    data: bytes, channels: dict[int, KeyedChannel], schemas: dict[int, Schema] | None = None
) -> Iterator[Entry]:
    """The messages in an uncompressed chunk: records of opcode, length and content, one after the other.

    Args:
        data: the chunk.
        channels: channels by number; messages of others are passed over.
        schemas: schemas by number; with them, what the chunk describes is learned. None: all is known.

    Raises:
        ValueError: a record is of no kind that the format knows, or belongs to a channel that was not described.
    """
    record, message = RECORD.unpack_from, MESSAGE.unpack_from
    at, end = 0, len(data)
    while at < end:
        opcode, length = record(data, at)
        at += RECORD.size
        if opcode == Opcode.MESSAGE:
            number, _, log_time, publish_time = message(data, at)
            channel = channels.get(number)
            if channel is not None:
                payload = data[at + MESSAGE.size : at + length]
                yield Entry(channel.key, payload, channel.encoding, log_time, publish_time, channel.repeated)
            elif schemas is not None:
                raise ValueError(f"channel {number} is described nowhere")
        elif not opcode:
            raise ValueError("the chunk holds a record of kind 0, which the format does not know")
        elif schemas is not None and opcode == Opcode.SCHEMA:
            schema = Schema.read(ReadDataStream(io.BytesIO(data[at : at + length])))
            schemas[schema.id] = schema
        elif schemas is not None and opcode == Opcode.CHANNEL:
            described = Channel.read(ReadDataStream(io.BytesIO(data[at : at + length])))
            channels[described.id] = channel_of(described, schemas)
        at += length


def damaged(path: Path, what: str, error: Exception | None = None) -> InputError:
    """The line about a damaged file."""
    why = f" ({str(error) or type(error).__name__})" if error else ""
    return InputError(f"{path}: {what}{why}; `reactorwatch recover {path}` saves what is whole in it")
