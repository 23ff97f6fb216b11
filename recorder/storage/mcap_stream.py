"""Fast writer of MCAP records: https://mcap.dev/spec.

The library's writer builds an object for each message and packs its fields one by one, which is most of the cost of
recording a small message. Here a message is packed at once, and the data of a chunk (times, index, counts) are
computed when the chunk ends. All other records are written by the library. The file is byte for byte that of the
library's writer.

Messages are collected in chunks of a mebibyte, compressed with zstd, each followed by an index of its messages. A
schema or channel is written in the chunk of its first message, as the format requires, and outside of it, so that a
damaged chunk does not leave later messages without a channel.
"""

import struct
import zlib
from collections.abc import Sequence
from typing import Protocol

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

CHUNK_BYTES = 1 << 20
"""Uncompressed size of a chunk, which ends with the message that exceeds it."""

_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length; channel, sequence, log time, publish time; then the payload
_MESSAGE_OPCODE = int(Opcode.MESSAGE)  # a plain number is packed faster
_MESSAGE_HEAD = _MESSAGE.size - 9  # the part that the length counts
_INDEX = struct.Struct("<BQHI")  # opcode, length; channel, length of the pairs of log time and offset that follow
_INDEX_HEAD = _INDEX.size - 9
_PAIR = 16
_SUMMED = struct.Struct("<BQQQ")  # the part of the footer that its checksum covers


class Sink(Protocol):
    """Byte stream to write to."""

    def write(self, data: bytes) -> int:
        """Append bytes."""

    def tell(self) -> int:
        """Number of bytes written."""

    def flush(self) -> None:
        """Flush the bytes."""


class McapStream:
    """Writes one file; the sink stays open.

    Args:
        sink: destination; its errors are passed on, and nothing may be written afterwards.
    """

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunk = bytearray()
        self._index: dict[int, list[int]] = {}  # by channel: log time and offset of each message, one after the other
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._counts: dict[int, int] = {}  # messages by channel, of the chunks that have ended
        self._unflushed: list[tuple[int, int]] = []  # end and messages of each chunk since the last flush
        self._compressor = zstandard.ZstdCompressor()

    def start(self, library: str, profile: str = "") -> None:
        """Write the magic bytes and the header."""
        self._sink.write(MCAP0_MAGIC + _bytes_of(Header(profile=profile, library=library)))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Write a schema and return its number."""
        schema = Schema(data=data, encoding=encoding, id=len(self._schemas) + 1, name=name)
        self._schemas.append(schema)
        self._describe(schema)
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Write a channel and return its number; `schema` 0 is none."""
        number = len(self._channels) + 1
        channel = Channel(id=number, topic=topic, message_encoding=encoding, metadata=metadata, schema_id=schema)
        self._channels.append(channel)
        self._describe(channel)
        return number

    @property
    def channel_count(self) -> int:
        """Number of channels."""
        return len(self._channels)

    def add_message(self, channel: int, log_time: int, payload: bytes, publish_time: int, sequence: int = 0) -> None:
        """Append a message."""
        chunk = self._chunk
        index = self._index.get(channel)
        if index is None:
            index = self._index[channel] = []
        index += (log_time, len(chunk))
        length = _MESSAGE_HEAD + len(payload)
        chunk += _MESSAGE.pack(_MESSAGE_OPCODE, length, channel, sequence, log_time, publish_time)
        chunk += payload
        if len(chunk) > CHUNK_BYTES:
            self._end_chunk()

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Append a metadata record, outside of any chunk."""
        offset = self._sink.tell()
        record = _bytes_of(Metadata(name=name, metadata=metadata))
        self._metadata.append(MetadataIndex(offset=offset, length=len(record), name=name))
        self._sink.write(record)

    def add_attachment(self, attachment: Attachment) -> None:
        """Append an attachment, outside of any chunk."""
        offset = self._sink.tell()
        record = _bytes_of(attachment)
        self._attachments.append(
            AttachmentIndex(
                offset=offset,
                length=len(record),
                log_time=attachment.log_time,
                create_time=attachment.create_time,
                data_size=len(attachment.data),
                name=attachment.name,
                media_type=attachment.media_type,
            )
        )
        self._sink.write(record)

    def flush(self) -> None:
        """End the chunk, if it has a message, and flush the sink."""
        self._end_chunk()
        self._sink.flush()
        self._unflushed.clear()

    def count_complete(self, size_bytes: int) -> int:
        """Count of the messages since the last flush whose chunks are within the first bytes of the file."""
        return sum(messages for end, messages in self._unflushed if end <= size_bytes)

    def finish(self) -> None:
        """Write the summary section and the footer."""
        self._end_chunk()
        self._sink.write(_bytes_of(DataEnd(0)))
        start = self._sink.tell()
        groups: tuple[tuple[Opcode, Sequence[McapRecord]], ...] = (
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attachments),
            (Opcode.METADATA_INDEX, self._metadata),
        )
        summary, offsets = bytearray(), bytearray()
        for opcode, records in groups:
            group_start = len(summary)
            summary += _bytes_of(*records)
            offsets += _bytes_of(SummaryOffset(opcode, start + group_start, len(summary) - group_start))
        offset_start = start + len(summary)
        summary += offsets
        summed = _SUMMED.pack(Opcode.FOOTER, 8 + 8 + 4, start, offset_start)
        footer = Footer(
            summary_start=start, summary_offset_start=offset_start, summary_crc=zlib.crc32(summed, zlib.crc32(summary))
        )
        self._sink.write(bytes(summary) + _bytes_of(footer) + MCAP0_MAGIC)

    def _describe(self, record: Channel | Schema) -> None:
        described = _bytes_of(record)
        self._chunk += described
        self._sink.write(described)

    def _end_chunk(self) -> None:
        if not self._index:
            return
        times = [time for index in self._index.values() for time in (min(index[::2]), max(index[::2]))]
        data = bytes(self._chunk)
        chunk = Chunk(
            compression="zstd",
            data=self._compressor.compress(data),
            message_start_time=min(times),
            message_end_time=max(times),
            uncompressed_crc=zlib.crc32(data),
            uncompressed_size=len(data),
        )
        start = self._sink.tell()
        record = _bytes_of(chunk)
        offsets, indexes = {}, bytearray()
        for channel, index in self._index.items():
            offsets[channel] = start + len(record) + len(indexes)
            count = len(index) // 2
            indexes += _INDEX.pack(Opcode.MESSAGE_INDEX, _INDEX_HEAD + _PAIR * count, channel, _PAIR * count)
            indexes += struct.pack(f"<{len(index)}Q", *index)
            self._counts[channel] = self._counts.get(channel, 0) + count
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(record),
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=len(indexes),
                message_index_offsets=offsets,
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        self._unflushed.append((start + len(record), sum(len(index) // 2 for index in self._index.values())))
        self._chunk.clear()
        self._index.clear()
        self._sink.write(record)
        self._sink.write(bytes(indexes))

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=max((chunk.message_end_time for chunk in self._chunks), default=0),
            message_start_time=min((chunk.message_start_time for chunk in self._chunks), default=0),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def _bytes_of(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
