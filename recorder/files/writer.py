"""Writer of recordings: the library's MCAP writer on a file that buffers.

A schema or channel is in the chunk of its first message, as the library writes it, and outside of it, so that a
damaged chunk does not leave later messages without a channel.

The file of an incomplete recording is locked, so that no other process takes it for an orphan. Bytes are buffered in
memory, and `drain` hands them to the operating system: only there a full disk shows. Drained bytes survive the process,
synced bytes the machine. The lock ends with the process, so a file without a lock is an orphan.
"""

import errno
import fcntl
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Schema
from mcap.records import Channel as ChannelRecord
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import message_type
from reactorwatch.errors import InputError
from reactorwatch.version import build_metadata, this_build
from recorder import Channel, RecordedMessage, StoredMessage
from recorder.keep import MAX_CHANNELS, channel_of
from recorder.samples import content_of

PART = ".part"
"""Ending of an incomplete recording."""
DELETED = "its file was deleted"


class PartFile:
    """New append-only file, with a lock; the stream of the library's writer.

    Args:
        path: the file; it must not exist.

    Attributes:
        chunk_end: end of the last chunk that was written, from the start of the file.
        drained: number of bytes handed to the operating system.

    Raises:
        OSError: it cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.chunk_end = self.drained = 0
        self._raw = path.open("xb", buffering=0)
        fcntl.flock(self._raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._pending = bytearray()

    def write(self, data: bytes) -> int:
        """Buffer bytes; the library writes a chunk record in one call."""
        self._pending += data
        if data[:1] == Opcode.CHUNK.to_bytes():
            self.chunk_end = self.tell()
        return len(data)

    def tell(self) -> int:
        """Number of bytes written, buffered ones included."""
        return self.drained + len(self._pending)

    def flush(self) -> None:
        """Do nothing: the library's writer calls it, and must never meet a full disk."""

    def drain(self) -> None:
        """Hand the buffer to the operating system; after an error it may be called again.

        Raises:
            OSError: the write failed, for example on a full disk, perhaps after part of the buffer; or the file was
                deleted, so that writes would succeed and be lost.
        """
        while self._pending:
            taken = self._append(self._pending)
            self.drained += taken
            del self._pending[:taken]
        if self._is_deleted:
            raise OSError(errno.ENOENT, DELETED)

    def sync(self) -> None:
        """Drain, and wait until all bytes are on the disk.

        Raises:
            OSError: as `drain`, or the sync failed.
        """
        self.drain()
        os.fsync(self._raw.fileno())

    def finish(self, path: Path) -> None:
        """Sync, rename to `path` while the lock is held, and close: a complete file is on the disk.

        Raises:
            OSError: as `sync`, or it cannot be renamed; it is closed under its old name.
        """
        try:
            self.sync()
            self.path.rename(path)
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close and drop the buffer; a second call does nothing."""
        self._pending.clear()
        self._raw.close()

    @property
    def closed(self) -> bool:
        """True after `finish` or `abandon`."""
        return self._raw.closed

    @property
    def _is_deleted(self) -> bool:
        """True if no file or another file has its name."""
        try:
            return not os.path.samestat(os.fstat(self._raw.fileno()), self.path.stat())
        except (FileNotFoundError, NotADirectoryError):
            return True

    def _append(self, data: bytearray) -> int:
        return self._raw.write(data)


def open_recording(path: Path) -> BinaryIO:
    """Open a file of a recording to read it; if its recorder completed it meanwhile, under its complete name.

    Raises:
        OSError: it cannot be opened.
    """
    try:
        return path.open("rb")
    except FileNotFoundError:
        if path.suffix != PART:
            raise
        return path.with_suffix("").open("rb")


def is_locked(path: Path) -> bool:
    """True if a running process writes the file; False if it does not exist."""
    try:
        with lock_orphan(path):
            return False
    except InputError:
        return True
    except FileNotFoundError:
        return False


@contextmanager
def lock_orphan(path: Path) -> Iterator[BinaryIO]:
    """Open and lock an orphan within the context.

    Raises:
        InputError: a process writes it.
        OSError: it cannot be opened, or was replaced since.
    """
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"{path}: is still being written; stop its recorder first") from error
        if not os.path.samestat(os.fstat(stream.fileno()), path.stat()):
            raise FileNotFoundError(f"{path}: is another file by now")
        yield stream


METADATA = "reactorwatch"
"""Name of the record that a writer of this software starts a file with."""
LATCHED = "reactorwatch.repeated"
"""Key in the metadata of a channel of latched messages, see `RecordedMessage.latched`."""


@dataclass(slots=True, eq=False, kw_only=True)
class StoredChannel(Channel):
    """Channel of a file that any program wrote, as it is described there."""

    record: ChannelRecord
    schema: Schema | None


class WriteError(InputError):
    """A file cannot be written; `reason` is the message of the operating system."""

    def __init__(self, text: str, reason: str) -> None:
        super().__init__(text)
        self.reason = reason


class RecordingWriter:
    """Writes a recording to `path + ".part"`, renamed to `path` by `close`.

    Args:
        path: the file; it must not exist, complete or not.
        metadata: metadata of the file, beside the version of this software.
        open_part: opens the file that is written to.
        profile: MCAP profile of the file.

    Raises:
        InputError: the file exists or cannot be written.
    """

    def __init__(
        self,
        path: Path,
        metadata: Mapping[str, str],
        open_part: Callable[[Path], PartFile] = PartFile,
        profile: str = "",
    ) -> None:
        self.path = path
        self._part = part_of(path)
        self._channels: dict[Channel, int] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._copies: dict[tuple[object, ...], int] = {}
        self._channel_count = 0
        self._in_chunk = 0  # messages in the current chunk
        self._chunk_end = 0
        self._undrained: list[tuple[int, int]] = []  # end and messages of each chunk since the last flush
        check_free(path)
        with self._write_errors():
            self._stream = open_part(self._part)
        self._writer = Writer(self._stream)  # type: ignore[arg-type]
        self._add_message = self._writer.add_message
        self._writer.start(profile, f"reactorwatch {this_build()}")
        build = {} if "version" in metadata else build_metadata()  # a copy keeps that of its source
        self._writer.add_metadata(METADATA, {**build, **metadata})
        try:
            self._stream.drain()
        except OSError as error:
            self._stream.abandon()
            self._part.unlink(missing_ok=True)  # nothing is in it
            raise self._write_error(error) from error

    @property
    def size_bytes(self) -> int:
        """Bytes written, without the current chunk."""
        return self._stream.tell()

    def write(self, message: RecordedMessage) -> None:
        """Append a message; the sequence number of a sample becomes that of the MCAP message.

        A payload that is not what its encoding names is written without a schema, so that it stops no reader.

        Raises:
            WriteError: as `append`.
        """
        key, payload, encoding, log_time_ns, publish_time_ns, latched = message
        content = content_of(message)
        sequence = content.sequence if isinstance(content, messages.Sample) else 0
        channel = channel_of(key, encoding, is_readable=content is not None, latched=latched)
        self.append(StoredMessage(channel, sequence, log_time_ns, publish_time_ns, payload))

    def has(self, channel: Channel) -> bool:
        """True if the channel has a message in the file."""
        return channel in self._channels

    def append(self, stored: StoredMessage) -> None:
        """Append a received message, or one of another file unchanged, with its channel.

        Raises:
            WriteError: the file cannot be written, for example because the disk is full.
        """
        channel = stored.channel
        number = self._channels.get(channel)
        if number is None:
            number = self._channels[channel] = self._register(channel)
        sequence = stored.sequence & 0xFFFF_FFFF  # 32 bits in MCAP: larger ones wrap around to 0
        self._add_message(number, stored.log_time_ns, stored.payload, stored.publish_time_ns, sequence)
        self._in_chunk += 1
        if self._stream.chunk_end != self._chunk_end:  # the chunk was full
            self._note_chunk()
            with self._write_errors():
                self._stream.drain()

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Append a metadata record, outside of any chunk.

        Raises:
            WriteError: as `write`.
        """
        self.flush()
        self._writer.add_metadata(name, metadata)

    def add_attachment(self, item: Attachment) -> None:
        """Append an attachment, outside of any chunk.

        Raises:
            WriteError: as `write`.
        """
        self.flush()
        self._writer.add_attachment(item.create_time, item.log_time, item.name, item.media_type, item.data)

    def flush(self) -> None:
        """End the chunk and hand all bytes to the operating system; after an error it may be called again.

        Raises:
            WriteError: the file cannot be written.
        """
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._note_chunk()
        with self._write_errors():
            self._stream.drain()
        self._undrained.clear()

    def sync(self) -> None:
        """Wait until flushed bytes are on the disk.

        Raises:
            WriteError: the file cannot be written.
        """
        with self._write_errors():
            self._stream.sync()

    def close(self) -> None:
        """Complete and rename the file; a second call does nothing.

        Raises:
            WriteError: the file cannot be written; flushed bytes stay in the `.part` file.
        """
        if self._stream.closed:
            return
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._note_chunk()
            with self._write_errors():
                self._stream.finish(self.path)
        finally:
            self._stream.abandon()

    def abandon(self) -> int:
        """Leave the file as it is, to be recovered; after `close` it does nothing.

        Returns:
            Count of the messages since the last flush that a recovery will find, because their chunks were written
            before the disk was full.
        """
        self._stream.abandon()
        return sum(messages for end, messages in self._undrained if end <= self._stream.drained)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _note_chunk(self) -> None:
        """Note the end of a chunk and its messages, if it has ended."""
        if self._stream.chunk_end != self._chunk_end:
            self._chunk_end = self._stream.chunk_end
            self._undrained.append((self._chunk_end, self._in_chunk))
            self._in_chunk = 0

    def _register(self, channel: Channel) -> int:
        if isinstance(channel, StoredChannel):
            record, described = channel.record, channel.schema
            number = self._schema(described.name, described.encoding, described.data) if described else 0
            name = (record.topic, record.message_encoding, number, *sorted(record.metadata.items()))
            if name not in self._copies:  # two readers have objects of their own for equal channels
                self._copies[name] = self._add_channel(record.topic, record.message_encoding, number, record.metadata)
            return self._copies[name]
        metadata = {LATCHED: "true"} if channel.latched else {}
        kind = message_type(channel.encoding) if channel.is_readable else None
        if kind is None:
            return self._add_channel(channel.key, channel.encoding, 0, metadata)
        schema = self._schema(kind.DESCRIPTOR.full_name, SchemaEncoding.Protobuf, _descriptors())
        return self._add_channel(channel.key, MessageEncoding.Protobuf, schema, metadata)

    def _add_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Add a channel, unless the format has no number left."""
        if self._channel_count >= MAX_CHANNELS:
            reason = f"a file has room for {MAX_CHANNELS} keys, and {topic!r} is one more"
            raise WriteError(f"recording {self.path}: {reason}", reason)
        self._channel_count += 1
        number = self._writer.register_channel(topic, encoding, schema, metadata)
        self._write_outside(ChannelRecord(number, topic, encoding, metadata, schema))
        return number

    def _schema(self, name: str, encoding: str, data: bytes) -> int:
        described = (name, encoding, data)
        number = self._schemas.get(described)
        if number is None:
            number = self._schemas[described] = self._writer.register_schema(name, encoding, data)
            self._write_outside(Schema(data=data, encoding=encoding, id=number, name=name))
        return number

    def _write_outside(self, record: ChannelRecord | Schema) -> None:
        self._note_chunk()  # the record may have filled it
        builder = RecordBuilder()
        record.write(builder)
        self._stream.write(builder.end())  # type: ignore[no-untyped-call]

    @contextmanager
    def _write_errors(self) -> Iterator[None]:
        """Raise errors of the operating system as `WriteError`."""
        try:
            yield
        except OSError as error:
            raise self._write_error(error) from error

    def _write_error(self, error: OSError) -> WriteError:
        kept = f"; what was written is in {self._part}" if self._part.exists() else ""
        reason = error.strerror or type(error).__name__
        return WriteError(f"recording {self.path}: cannot be written: {reason}{kept}", reason)


def part_of(path: Path) -> Path:
    """Name of a recording until it is complete."""
    return path.with_name(path.name + PART)


def check_free(path: Path) -> None:
    """Check that a recording of that name can be started.

    Raises:
        InputError: it exists, complete or not, or its folder does not exist.
    """
    part = part_of(path)
    if not path.parent.is_dir():
        raise InputError(f"recording {path}: the folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"recording {path}: the folder {path.parent} cannot be written to")
    if path.exists():
        raise InputError(f"recording {path}: exists already and is not overwritten; choose another name")
    if is_locked(part):
        raise InputError(f"recording {path}: {part} is being written by another recorder; choose another name")
    if part.exists():
        raise InputError(
            f"recording {path}: {part} was left by a recorder that was killed; "
            f"`reactorwatch recover {part}` saves what is whole in it"
        )


@cache
def _descriptors() -> bytes:
    proto = FileDescriptorProto()
    messages.DESCRIPTOR.CopyToProto(proto)
    return FileDescriptorSet(file=[proto]).SerializeToString()
