"""Sequential scan of an MCAP file that tolerates damage.

The scan needs no index and no end, so it also reads a file that is cut off, damaged or still being written. A chunk
with damaged content is skipped by its length. Where a length is damaged, the next chunk is searched for by the name of
its compression and by the lengths around it, which must be consistent. The content of a chunk is used only if its
checksum matches.
"""

import io
import mmap
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from reactorwatch.errors import InputError
from reactorwatch.records.input_file import wrap_read_errors
from recorder.message import RecordedMessage
from recorder.storage.chunk_data import FIRST_PRIVATE, chunk_data
from recorder.storage.mcap_chunks import (
    DAMAGE,
    FOOTER,
    LATCHED,
    MESSAGE,
    RECORD,
    damage_error,
    foreign_file_error,
    keyed_channel,
    read_summary,
)

LATEST_NS = 2**64 - 1

Wanted = Callable[[str], bool]
"""Returns True for topics to read."""

ChannelOrSchema = TypeVar("ChannelOrSchema", Channel, Schema)

_CHUNK_TIMES = struct.Struct("<QQ")  # log times of the first and the last message
_BEFORE_COMPRESSION = RECORD.size + 8 + 8 + 8 + 4 + 4  # bytes of a chunk before the name of its compression
_NAME_LENGTH, _DATA_LENGTH = struct.Struct("<I"), struct.Struct("<Q")
_INDEX = struct.Struct("<HI")  # channel of a message index, length of the rest
_CHECKSUM = struct.Struct("<I")
_COMPRESSIONS = (b"zstd", b"lz4")
_OPCODES = frozenset(Opcode)


class RawMessage(NamedTuple):
    """A message of a file, written by any program, with its channel and schema records."""

    channel: Channel
    schema: Schema | None
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    payload: bytes

    @property
    def latched(self) -> bool:
        """True for a latched message, see `RecordedMessage`."""
        return LATCHED in self.channel.metadata

    @property
    def recorded_message(self) -> RecordedMessage:
        """The message as the recorder writes it."""
        schemas = {self.schema.id: self.schema} if self.schema is not None else {}
        key, encoding, repeated = keyed_channel(self.channel, schemas)
        return RecordedMessage(key, self.payload, encoding, self.log_time_ns, self.publish_time_ns, repeated)


class Damage(NamedTuple):
    """Unreadable part of a file; `is_end` if only the end of the file is missing."""

    at_byte: int
    what: str
    is_end: bool = False

    def __str__(self) -> str:
        return f"{self.what} at byte {self.at_byte}"


class Scan:
    """One pass over a file.

    Args:
        path: the file.
        from_ns: chunks that were received entirely before this time are skipped.
        to_ns: chunks that were received entirely after this time are skipped.
        wanted: selects the topics to read; None reads all.
        skip_private: True to skip records that are private to other programs; False takes them for damage, as the
            opcode of any record may be damaged.

    Attributes:
        damages: unreadable parts; complete after the pass.
        metadata: metadata records; complete after the pass.
        profile: MCAP profile of the file; set from the first message on.
        orphans: number of messages whose channel is described nowhere.

    Raises:
        InputError: the file does not exist, is empty, or contains nothing of a recording.
    """

    def __init__(
        self,
        path: Path,
        from_ns: int = 0,
        to_ns: int = LATEST_NS,
        wanted: Wanted | None = None,
        *,
        skip_private: bool = False,
    ) -> None:
        self.damages: list[Damage] = []
        self.metadata: list[Metadata] = []
        self.profile = ""
        self._attached: list[tuple[int, int]] = []
        self.orphans = 0
        self._wanted, self._skip_private = wanted, skip_private
        self._path, self._from_ns, self._to_ns = path, from_ns, to_ns
        self._ended = False
        self._channels: dict[int, Channel] = {}
        self._schemas: dict[int, Schema] = {}
        self._indexed_bytes: dict[int, int] = {}  # uncompressed size by offset of the chunk
        self._verified: set[tuple[type, int]] = set()  # channels and schemas confirmed by a checksum
        with wrap_read_errors(path), path.open("rb") as stream:
            self._size = os.fstat(stream.fileno()).st_size
            if not self._size:
                raise InputError(f"{path}: expected an MCAP recording, got an empty file")
            self._bytes = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        self._start = len(MCAP0_MAGIC)
        if self._bytes[: self._start] != MCAP0_MAGIC:
            chunk = self._next_chunk(0)
            if chunk is None and not MCAP0_MAGIC.startswith(self._bytes[: self._start]):
                raise foreign_file_error(path)
            self.damages.append(Damage(0, "the beginning cannot be read"))
            self._start = self._size if chunk is None else chunk

    @property
    def is_intact(self) -> bool:
        """True after the pass if the file has its end and no damage was found."""
        return self._ended and not self.damages and not self.orphans

    def check_intact(self) -> None:
        """Check after the pass that everything was read.

        Raises:
            InputError: the file is damaged, or has no end.
        """
        if not self.is_intact:
            damages = "; ".join(map(str, self.damages))
            raise damage_error(self._path, damages or "some channels are described nowhere")

    def __iter__(self) -> Iterator[RawMessage]:
        """Messages in the order of the file."""
        self._load_summary()
        at = self._start
        while at < self._size and not self._ended:
            opcode, end = self._record_at(at)
            if end is None:
                following = self._next_chunk(at + 1)
                if following is None:
                    break
                self.damages.append(Damage(at, f"{following - at} bytes"))
                at = following
                continue
            try:
                yield from self._messages(opcode, at + RECORD.size, end)
            except DAMAGE as error:
                name = "a chunk" if opcode == Opcode.CHUNK else "a record"
                self.damages.append(Damage(at, f"{name} of {end - at} bytes ({str(error) or type(error).__name__})"))
            at = end
        if not self._ended:
            unfinished = f", after {self._size - at} bytes of an unfinished record," if at < self._size else ""
            self.damages.append(Damage(self._size, f"cut off{unfinished}", is_end=True))

    def attachments(self) -> Iterator[Attachment]:
        """Attachments, after the pass; a damaged one is added to `damages` and skipped."""
        for start, end in self._attached:
            content = self._bytes[start:end]
            (checksum,) = _CHECKSUM.unpack(content[-_CHECKSUM.size :])
            try:
                if checksum not in (0, zlib.crc32(content[: -_CHECKSUM.size])):  # 0: there is none
                    raise ValueError("its checksum does not agree")
                yield Attachment.read(_stream(content))
            except DAMAGE as error:
                self.damages.append(Damage(start, f"an attachment ({error})"))

    def _load_summary(self) -> None:
        """Read channels and schemas from an intact index, as a damaged chunk may have held their records."""
        try:
            summary = read_summary(self._path)
        except InputError:
            return
        self._indexed_bytes = {chunk.chunk_start_offset: chunk.uncompressed_size for chunk in summary.chunk_indexes}
        self._channels.update(summary.channels)
        self._schemas.update(summary.schemas)
        self._verified.update((Channel, number) for number in summary.channels)
        self._verified.update((Schema, number) for number in summary.schemas)

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
                possible = length >= MESSAGE.size
            case Opcode.MESSAGE_INDEX:
                possible = length >= _INDEX.size and _INDEX.unpack_from(self._bytes, content)[1] == length - _INDEX.size
        return opcode, end if possible else None

    def _messages(self, opcode: int, start: int, end: int) -> Iterator[RawMessage]:
        match opcode:
            case Opcode.CHUNK:
                first_ns, last_ns = _CHUNK_TIMES.unpack_from(self._bytes, start)
                if last_ns >= self._from_ns and first_ns <= self._to_ns and self._may_be_wanted(end):
                    yield from self._in_chunk(start, end)
            case Opcode.MESSAGE:
                yield from self._in_records(self._bytes[start - RECORD.size : end], verified=False)
            case Opcode.CHANNEL | Opcode.SCHEMA:
                self._register(opcode, self._bytes[start:end], verified=False)
            case Opcode.METADATA:
                self.metadata.append(Metadata.read(_stream(self._bytes[start:end])))
            case Opcode.HEADER:
                self.profile = Header.read(_stream(self._bytes[start:end])).profile
            case Opcode.ATTACHMENT:
                self._attached.append((start, end))
            case Opcode.FOOTER:
                if self._bytes[end:] != MCAP0_MAGIC:
                    raise ValueError("the last bytes are not those of a recording")
                self._ended = True
            case _ if opcode not in _OPCODES and not (self._skip_private and opcode >= FIRST_PRIVATE):
                raise ValueError("of no known kind")

    def _may_be_wanted(self, at: int) -> bool:
        """True unless the message indexes after a chunk show that it has no wanted topic."""
        if self._wanted is None:
            return True
        is_indexed = False
        while at < self._size:
            opcode, end = self._record_at(at)
            if opcode != Opcode.MESSAGE_INDEX or end is None:
                break
            channel = self._channels.get(_INDEX.unpack_from(self._bytes, at + RECORD.size)[0])
            if channel is None or self._wanted(channel.topic):
                return True
            is_indexed, at = True, end
        return not is_indexed

    def _in_chunk(self, start: int, end: int) -> list[RawMessage]:
        chunk = Chunk.read(_stream(self._bytes[start:end]))
        data = chunk_data(chunk, self._indexed_bytes.get(start - RECORD.size))
        return list(self._in_records(data, verified=chunk.uncompressed_crc != 0))

    def _in_records(self, data: bytes, *, verified: bool) -> Iterator[RawMessage]:
        at, channels, schemas = 0, self._channels, self._schemas
        while at < len(data):
            opcode, length = RECORD.unpack_from(data, at)
            at += RECORD.size
            if opcode == Opcode.MESSAGE:
                number, sequence, log_time, publish_time = MESSAGE.unpack_from(data, at)
                channel = channels.get(number)
                schema = schemas.get(channel.schema_id) if channel else None
                if channel is None or (channel.schema_id and schema is None):
                    self.orphans += 1
                elif self._wanted is None or self._wanted(channel.topic):
                    yield RawMessage(
                        channel, schema, sequence, log_time, publish_time, data[at + MESSAGE.size : at + length]
                    )
            elif not opcode:
                raise ValueError("the chunk holds a record of kind 0, which the format does not know")
            elif opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
                self._register(opcode, data[at : at + length], verified=verified)
            at += length

    def _register(self, opcode: int, content: bytes, *, verified: bool) -> None:
        """Register a channel or a schema; one confirmed by a checksum is not replaced by one that is not."""
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(_stream(content))
            self._store(self._channels, channel.id, channel, verified=verified)
        else:
            schema = Schema.read(_stream(content))
            self._store(self._schemas, schema.id, schema, verified=verified)

    def _store(self, known: dict[int, ChannelOrSchema], number: int, item: ChannelOrSchema, *, verified: bool) -> None:
        name = (type(item), number)
        if known.get(number) != item and (verified or name not in self._verified):
            known[number] = item  # an equal one stays the same object
        if verified:
            self._verified.add(name)

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


def unindexed_messages(path: Path) -> Iterator[RecordedMessage]:
    """All messages in the order of receipt; they are in memory at once.

    Raises:
        InputError: the file is damaged.
    """
    scan = Scan(path, skip_private=True)
    messages = sorted((stored.recorded_message for stored in scan), key=attrgetter("log_time_ns"))
    scan.check_intact()
    yield from messages


def profile_of(path: Path) -> str:
    """MCAP profile of a file, damaged or not; it is in the first record.

    Raises:
        InputError: as `Scan`.
    """
    scan = Scan(path)
    next(iter(scan), None)
    return scan.profile


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))
