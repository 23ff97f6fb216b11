"""Reader of MCAP files (https://mcap.dev/spec), tolerant of damage or not.

There is one pass over the records of a file. If it is tolerant, it needs no index and no end, so it also reads a file
that is cut off, damaged or still being written: a chunk with damaged content is skipped by its length. Where a length
is damaged, the next chunk is searched for by the name of its compression and by the lengths around it, which must be
consistent. The content of a chunk is used only if its checksum matches.

Messages are parsed here, as the library builds an object for each.
"""

import io
import mmap
import os
import struct
import zlib
from collections import deque
from collections.abc import Callable, Collection, Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk, Header, Metadata, Schema
from mcap.records import Channel as ChannelRecord
from mcap.summary import Summary
from mcap.well_known import MessageEncoding
from mcap.writer import MCAP0_MAGIC

from reactorwatch.contract import keys
from reactorwatch.contract.codec import PREFIX
from reactorwatch.errors import InputError
from reactorwatch.records.decode import wrap_read_errors
from recorder import StoredMessage
from recorder.files.index import (
    DAMAGE,
    FIRST_PRIVATE,
    FOOTER,
    LATEST_NS,
    RECORD,
    damage_error,
    decompress,
    foreign_file_error,
    is_indexed,
    read_summary,
)
from recorder.files.writer import LATCHED, PART, StoredChannel, open_recording

Wanted = Callable[[str], bool]
"""Returns True for topics to read."""


def select_topics(kinds: Collection[str] | None, plant: str | None = None) -> Wanted:
    """Topics of the product of some kinds, such as `keys.SAMPLE`, and of a plant; None for all of them.

    Topics of other programs are selected only if nothing is excluded.
    """

    def is_selected(key: str) -> bool:
        topic = keys.parse(key)
        if topic is None:
            return kinds is None and plant is None
        return (kinds is None or topic.kind in kinds) and (plant is None or topic.plant == plant)

    return is_selected


_OPCODES = frozenset(Opcode)
_MESSAGE_OPCODE = int(Opcode.MESSAGE)  # a plain number compares faster
_COMPRESSIONS = (b"zstd", b"lz4")
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length; channel, sequence, log time, publish time; then the payload
_CHUNK_TIMES = struct.Struct("<QQ")  # log times of the first and the last message
_BEFORE_COMPRESSION = RECORD.size + 8 + 8 + 8 + 4 + 4  # bytes of a chunk before the name of its compression
_NAME_LENGTH, _DATA_LENGTH = struct.Struct("<I"), struct.Struct("<Q")
_INDEX = struct.Struct("<HI")  # channel of a message index, length of the rest
_CHECKSUM = struct.Struct("<I")


class Damage(NamedTuple):
    """Unreadable part of a file; `is_end` if only the end of the file is missing."""

    at_byte: int
    what: str
    is_end: bool = False

    def __str__(self) -> str:
        return f"{self.what} at byte {self.at_byte}"


class Reader:
    """One pass over a file.

    Args:
        path: the file.
        from_ns: chunks that were received entirely before this time are skipped.
        to_ns: chunks that were received entirely after this time are skipped.
        wanted: selects the topics to read; None reads all.
        tolerant: True to skip damage, and a missing end. Records that are private to other programs are damage then,
            as the opcode of any record may be damaged.

    Attributes:
        summary: index of the file; empty if it has none or, to a tolerant reader, if it is damaged.
        damages: unreadable parts; complete after the pass.
        metadata: metadata records; complete after the pass.
        profile: MCAP profile of the file; set from the first message on.
        library: program that wrote the file, as it states itself; set from the first message on.
        orphans: number of messages whose channel is described nowhere.

    Raises:
        InputError: the file does not exist, is empty, or contains nothing of a recording. Without `tolerant`, also if
            it is damaged; damage within the file is raised when the pass reaches it.
    """

    def __init__(
        self,
        path: Path,
        from_ns: int = 0,
        to_ns: int = LATEST_NS,
        wanted: Wanted | None = None,
        *,
        tolerant: bool = False,
    ) -> None:
        self.damages: list[Damage] = []
        self.metadata: list[Metadata] = []
        self.profile = self.library = ""
        self.orphans = 0
        self._path, self._from_ns, self._to_ns = path, from_ns, to_ns
        self._wanted, self._tolerant = wanted, tolerant
        self._attached: list[tuple[int, int]] = []
        with wrap_read_errors(path), open_recording(path) as stream:
            if not os.fstat(stream.fileno()).st_size:
                raise InputError(f"{path}: expected an MCAP recording, got an empty file")
            self._bytes = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        self._size = len(self._bytes)
        self._start = len(MCAP0_MAGIC)
        if tolerant and self._bytes[: self._start] != MCAP0_MAGIC:
            chunk = self._next_chunk(0)
            if chunk is None and not MCAP0_MAGIC.startswith(self._bytes[: self._start]):
                raise foreign_file_error(path)
            self.damages.append(Damage(0, "the beginning cannot be read"))
            self._start = self._size if chunk is None else chunk
        try:
            self.summary = read_summary(path, self._bytes)
        except InputError:
            if not tolerant:
                raise
            self.summary = Summary()
        self._indexed_bytes = {
            chunk.chunk_start_offset: chunk.uncompressed_size for chunk in self.summary.chunk_indexes
        }
        # the index describes the channels and schemas of a damaged chunk as well
        self._described: dict[type, dict[int, Any]] = {
            ChannelRecord: dict(self.summary.channels),
            Schema: dict(self.summary.schemas),
        }
        self._verified = {(kind, number) for kind, records in self._described.items() for number in records}
        self._channels: dict[int, StoredChannel | None] = {}  # by number; None: not wanted

    def __iter__(self) -> Iterator[StoredMessage]:
        """Messages in the order of the file."""
        at, ended = self._start, False
        while at < self._size and not ended:
            opcode, end = self._record_at(at)
            if end is None:
                following = self._next_chunk(at + 1)
                if following is None:
                    break
                self._add_damage(at, f"{following - at} bytes")
                at = following
                continue
            yield from self._read(opcode, at, end)
            ended = opcode == Opcode.FOOTER
            at = end
        if not ended:
            unfinished = f", after {self._size - at} bytes of an unfinished record," if at < self._size else ""
            self._add_damage(self._size, f"cut off{unfinished}", is_end=True)

    def in_order(self) -> Iterator[StoredMessage]:
        """Messages in the order of receipt; those of equal time in the order of the file.

        A chunk is read when its first message is due. A file without an index is read into memory at once.
        """
        if not is_indexed(self.summary):
            yield from sorted(self, key=attrgetter("log_time_ns"))
            return
        chunks = sorted(self.summary.chunk_indexes, key=attrgetter("message_start_time", "chunk_start_offset"))
        starts_ns = [chunk.message_start_time for chunk in chunks[1:]]
        waiting: dict[int, list[StoredMessage]] = {}  # by offset of the chunk
        for chunk, until_ns in zip(chunks, [*starts_ns, LATEST_NS + 1], strict=True):
            at = chunk.chunk_start_offset
            opcode, end = self._record_at(at)
            if opcode != Opcode.CHUNK or end is None:
                self._add_damage(at, "the index names a chunk where there is none")
                continue
            waiting[at] = self._read(opcode, at, end)
            due = [item for offset in sorted(waiting) for item in waiting[offset] if item.log_time_ns < until_ns]
            due.sort(key=attrgetter("log_time_ns"))  # stable, and fast if sorted already
            yield from due
            later = {at: [item for item in items if item.log_time_ns >= until_ns] for at, items in waiting.items()}
            waiting = {at: items for at, items in later.items() if items}

    def attachments(self) -> Iterator[Attachment]:
        """Attachments, after the pass."""
        for start, end in self._attached:
            content = self._bytes[start:end]
            (checksum,) = _CHECKSUM.unpack(content[-_CHECKSUM.size :])
            try:
                if checksum not in (0, zlib.crc32(content[: -_CHECKSUM.size])):  # 0: there is none
                    raise ValueError("its checksum does not agree")
                yield Attachment.read(_stream(content))
            except DAMAGE as error:
                self._add_damage(start, f"an attachment ({error})")

    def read_indexed_metadata(self) -> None:
        """Read the metadata records that the index names, without a pass.

        Raises:
            InputError: one cannot be read.
        """
        for item in self.summary.metadata_indexes:
            opcode, end = self._record_at(item.offset)
            try:
                if opcode != Opcode.METADATA or end is None:
                    raise ValueError("the index names another record")
                self._messages(opcode, item.offset + RECORD.size, end)
            except DAMAGE as error:
                raise damage_error(self._path, "its metadata cannot be read", error) from error

    def _add_damage(self, at: int, what: str, *, is_end: bool = False) -> None:
        damage = Damage(at, what, is_end)
        if not self._tolerant:
            raise damage_error(self._path, str(damage))
        self.damages.append(damage)

    def _read(self, opcode: int, at: int, end: int) -> list[StoredMessage]:
        """Messages of a record; damage is noted or raised."""
        try:
            return self._messages(opcode, at + RECORD.size, end)
        except DAMAGE as error:
            if not self._tolerant:
                name = "chunk" if opcode == Opcode.CHUNK else "record"
                raise damage_error(self._path, f"the {name} at byte {at} cannot be read", error) from error
            name = "a chunk" if opcode == Opcode.CHUNK else "a record"
            self._add_damage(at, f"{name} of {end - at} bytes ({str(error) or type(error).__name__})")
            return []

    def _record_at(self, at: int) -> tuple[int, int | None]:
        """Opcode and end of a record; the end is None if the record is implausible."""
        if at + RECORD.size > self._size:
            return 0, None
        opcode, length = RECORD.unpack_from(self._bytes, at)
        content, end = at + RECORD.size, at + RECORD.size + length
        possible = end <= self._size and opcode != 0
        if not possible:
            return opcode, None
        match opcode:
            case Opcode.FOOTER:
                possible = end == self._size - len(MCAP0_MAGIC) and at + FOOTER.size == end
            case Opcode.DATA_END:
                possible = length == _NAME_LENGTH.size
            case Opcode.CHUNK:
                possible = self._is_chunk(at)
            case Opcode.MESSAGE:
                possible = length >= _MESSAGE.size - RECORD.size
            case Opcode.MESSAGE_INDEX:
                possible = length >= _INDEX.size and _INDEX.unpack_from(self._bytes, content)[1] == length - _INDEX.size
        return opcode, end if possible else None

    def _messages(self, opcode: int, start: int, end: int) -> list[StoredMessage]:
        match opcode:
            case Opcode.CHUNK:
                first_ns, last_ns = _CHUNK_TIMES.unpack_from(self._bytes, start)
                if last_ns >= self._from_ns and first_ns <= self._to_ns and self._may_be_wanted(end):
                    chunk = Chunk.read(_stream(self._bytes[start:end]))
                    data = decompress(chunk, self._indexed_bytes.get(start - RECORD.size))
                    return self._in_records(data, verified=chunk.uncompressed_crc != 0)
            case Opcode.MESSAGE | Opcode.CHANNEL | Opcode.SCHEMA:
                return self._in_records(self._bytes[start - RECORD.size : end], verified=False)
            case Opcode.METADATA:
                self.metadata.append(Metadata.read(_stream(self._bytes[start:end])))
            case Opcode.HEADER:
                header = Header.read(_stream(self._bytes[start:end]))
                self.profile, self.library = header.profile, header.library
            case Opcode.ATTACHMENT:
                self._attached.append((start, end))
            case Opcode.FOOTER:
                if self._bytes[end:] != MCAP0_MAGIC:
                    raise ValueError("the last bytes are not those of a recording")
            case _ if opcode not in _OPCODES and (self._tolerant or opcode < FIRST_PRIVATE):
                raise ValueError("of no known kind")
        return []

    def _may_be_wanted(self, at: int) -> bool:
        """True unless the message indexes after a chunk show that it has no wanted topic."""
        if self._wanted is None:
            return True
        is_indexed = False
        while at < self._size:
            opcode, end = self._record_at(at)
            if opcode != Opcode.MESSAGE_INDEX or end is None:
                break
            channel = self._described[ChannelRecord].get(_INDEX.unpack_from(self._bytes, at + RECORD.size)[0])
            if channel is None or self._wanted(channel.topic):
                return True
            is_indexed, at = True, end
        return not is_indexed

    def _in_records(self, data: bytes, *, verified: bool) -> list[StoredMessage]:
        """Messages of records that follow each other; channels and schemas among them are registered."""
        found: list[StoredMessage] = []
        channels = self._channels
        append, unpack = found.append, _MESSAGE.unpack_from  # this runs for each message
        at, end = 0, len(data)
        while at < end:
            opcode = data[at]
            if opcode == _MESSAGE_OPCODE:
                _, length, number, sequence, log_time, publish_time = unpack(data, at)
                if number not in channels:
                    self._find_channel(number)
                channel = channels.get(number)
                if channel is not None:
                    payload = data[at + _MESSAGE.size : at + RECORD.size + length]
                    append(StoredMessage(channel, sequence, log_time, publish_time, payload))
            else:
                _, length = RECORD.unpack_from(data, at)
                content = data[at + RECORD.size : at + RECORD.size + length]
                if not opcode:
                    raise ValueError("the chunk holds a record of kind 0, which the format does not know")
                if opcode == Opcode.CHANNEL:
                    channel_record = ChannelRecord.read(_stream(content))
                    self._register(channel_record.id, channel_record, verified=verified)
                elif opcode == Opcode.SCHEMA:
                    schema = Schema.read(_stream(content))
                    self._register(schema.id, schema, verified=verified)
            at += RECORD.size + length
        if at != end:
            raise ValueError("a record reaches beyond the end")
        return found

    def _find_channel(self, number: int) -> None:
        """Add the channel of a message to `_channels`; if it is described nowhere, the message is an orphan."""
        record = self._described[ChannelRecord].get(number)
        schema = self._described[Schema].get(record.schema_id) if record else None
        if record is None or (record.schema_id and schema is None):
            if not self._tolerant:
                raise ValueError(f"channel {number} is described nowhere")
            self.orphans += 1
        elif self._wanted is not None and not self._wanted(record.topic):
            self._channels[number] = None
        else:
            encoding = record.message_encoding
            if encoding == MessageEncoding.Protobuf and schema is not None:
                encoding = PREFIX + schema.name
            latched = LATCHED in record.metadata
            self._channels[number] = StoredChannel(
                key=record.topic, encoding=encoding, latched=latched, record=record, schema=schema
            )

    def _register(self, number: int, record: ChannelRecord | Schema, *, verified: bool) -> None:
        """Register a channel or a schema; one confirmed by a checksum is not replaced by one that is not."""
        kind = type(record)
        known = self._described[kind]
        if known.get(number) != record and (verified or (kind, number) not in self._verified):
            known[number] = record
            self._channels.clear()  # an equal one leaves the channels the same objects
        if verified:
            self._verified.add((kind, number))

    def _next_chunk(self, start: int) -> int | None:
        """Offset of the next record that is consistent as a chunk; None if there is none."""
        nearest: int | None = None
        for name in _COMPRESSIONS:
            at = self._bytes.find(name, start + _BEFORE_COMPRESSION)
            while at >= 0 and (nearest is None or at - _BEFORE_COMPRESSION < nearest):
                if self._is_chunk(at - _BEFORE_COMPRESSION):
                    nearest = at - _BEFORE_COMPRESSION
                    break
                at = self._bytes.find(name, at + 1)
        return nearest

    def _is_chunk(self, at: int) -> bool:
        """True if the lengths within a record are consistent with a chunk."""
        opcode, length = RECORD.unpack_from(self._bytes, at)
        if opcode != Opcode.CHUNK or at + RECORD.size + length > self._size:
            return False
        head = _BEFORE_COMPRESSION - RECORD.size
        if length < head + _DATA_LENGTH.size:
            return False
        (name_length,) = _NAME_LENGTH.unpack_from(self._bytes, at + _BEFORE_COMPRESSION - _NAME_LENGTH.size)
        if head + name_length + _DATA_LENGTH.size > length:
            return False
        (data_length,) = _DATA_LENGTH.unpack_from(self._bytes, at + _BEFORE_COMPRESSION + name_length)
        return bool(head + name_length + _DATA_LENGTH.size + data_length == length)


def metadata_records(path: Path) -> list[Metadata]:
    """Metadata records of a file, complete or being recorded.

    Raises:
        InputError: as `Reader`.
    """
    reader = Reader(path, wanted=lambda _: False, tolerant=path.suffix == PART)
    if reader.summary.chunk_indexes or reader.summary.metadata_indexes:
        reader.read_indexed_metadata()
    else:
        deque(reader, maxlen=0)
    return reader.metadata


def read_start(path: Path) -> Reader:
    """Tolerant reader of a file after its first message, so that header and first metadata are read.

    Raises:
        InputError: as `Reader`.
    """
    reader = Reader(path, tolerant=True)
    next(iter(reader), None)
    return reader


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))
