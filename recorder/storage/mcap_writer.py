"""Writer of recordings as MCAP files, on top of `mcap_stream`."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Self

from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from mcap.records import Attachment, Channel, Metadata
from mcap.well_known import MessageEncoding, SchemaEncoding

from reactorwatch import __version__
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import encoding_of, message_type
from reactorwatch.contract.sample_bytes import read_sequence
from reactorwatch.errors import InputError
from recorder.message import RecordedMessage
from recorder.policy.channel_budget import MAX_CHANNELS
from recorder.storage.mcap_chunks import LATCHED
from recorder.storage.mcap_scan import RawMessage
from recorder.storage.mcap_stream import McapStream
from recorder.storage.part_file import PART, PartFile, is_locked

METADATA = "reactorwatch"
MAX_SEQUENCE = 2**32 - 1
"""Largest sequence number in MCAP; larger ones wrap around to 0."""

_SAMPLE = encoding_of(messages.Sample)

FILE_INDEX = "file"
"""Metadata key: index of the file within its run, from 1, if a recorder wrote it."""


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
        self._path = path
        self._part = part_of(path)
        self._channels: dict[tuple[str, str, bool, bool], int] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._copied: dict[
            int, tuple[Channel, int]
        ] = {}  # by identity, which is stable because the channel is held here
        self._copies: dict[tuple[object, ...], int] = {}
        check_free(path)
        with self._write_errors():
            self._stream = open_part(self._part)
        self._writer = McapStream(self._stream)
        try:
            self._writer.start(f"reactorwatch {__version__}", profile)
            self._writer.add_metadata(METADATA, {"version": __version__, **metadata})
            self._stream.flush()
        except OSError as error:
            self._stream.abandon()
            self._part.unlink(missing_ok=True)  # nothing is in it
            raise self._write_error(error) from error

    @property
    def path(self) -> Path:
        """Final name of the file."""
        return self._path

    @property
    def size_bytes(self) -> int:
        """Bytes written, without the current chunk."""
        return self._stream.tell()

    def write(self, message: RecordedMessage, *, readable: bool = True, sequence: int | None = None) -> None:
        """Append a message; the sequence number of a sample becomes that of the MCAP message.

        Args:
            message: the message.
            readable: False writes the payload without the schema that its encoding names.
            sequence: sequence number of a sample, else 0, where it is known; None: it is read from the payload.

        Raises:
            WriteError: the file cannot be written, for example because the disk is full.
        """
        key, payload, encoding, log_time_ns, publish_time_ns, latched = message
        try:
            name = (key, encoding, readable, latched)
            channel = self._channels.get(name)
            if channel is None:
                channel = self._channels[name] = self._register(message, readable=readable)
            if sequence is None:
                sequence = read_sequence(payload) if readable and encoding == _SAMPLE else 0
            self._writer.add_message(channel, log_time_ns, payload, publish_time_ns, sequence & MAX_SEQUENCE)
        except OSError as error:
            raise self._write_error(error) from error

    def copy(self, stored: RawMessage) -> None:
        """Append a message of another file unchanged, with its channel.

        Raises:
            WriteError: as `write`.
        """
        try:
            known = self._copied.get(id(stored.channel))
            if known is None:
                known = self._copied[id(stored.channel)] = stored.channel, self._copied_channel(stored)
            self._writer.add_message(
                known[1], stored.log_time_ns, stored.payload, stored.publish_time_ns, stored.sequence
            )
        except OSError as error:
            raise self._write_error(error) from error

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Append a metadata record.

        Raises:
            WriteError: as `write`.
        """
        with self._write_errors():
            self._writer.flush()
            self._writer.add_metadata(name, metadata)

    def add_attachment(self, attachment: Attachment) -> None:
        """Append an attachment.

        Raises:
            WriteError: as `write`.
        """
        with self._write_errors():
            self._writer.flush()
            self._writer.add_attachment(attachment)

    def flush(self) -> None:
        """End the chunk and hand all bytes to the operating system.

        Raises:
            WriteError: the file cannot be written.
        """
        with self._write_errors():
            self._writer.flush()

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
            with self._write_errors():
                self._writer.finish()
                self._stream.finish(self._path)
        finally:
            self._stream.abandon()

    def abandon(self) -> int:
        """Leave the file as it is, to be recovered; after `close` it does nothing.

        Returns:
            Count of the messages since the last flush that a recovery will find, because their chunks were written
            before the disk was full.
        """
        self._stream.abandon()
        return self._writer.count_complete(self._stream.flushed_bytes)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _register(self, message: RecordedMessage, *, readable: bool) -> int:
        metadata = {LATCHED: "true"} if message.latched else {}
        kind = message_type(message.encoding) if readable else None
        if kind is None:
            return self._add_channel(message.key, message.encoding, 0, metadata)
        schema = self._schema(kind.DESCRIPTOR.full_name, SchemaEncoding.Protobuf, _descriptors())
        return self._add_channel(message.key, MessageEncoding.Protobuf, schema, metadata)

    def _add_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Add a channel, unless the format has no number left."""
        if self._writer.channel_count >= MAX_CHANNELS:
            reason = f"a file has room for {MAX_CHANNELS} keys, and {topic!r} is one more"
            raise WriteError(f"recording {self._path}: {reason}", reason)
        return self._writer.add_channel(topic, encoding, schema, metadata)

    def _copied_channel(self, stored: RawMessage) -> int:
        channel, schema = stored.channel, stored.schema
        number = self._schema(schema.name, schema.encoding, schema.data) if schema else 0
        name = (channel.topic, channel.message_encoding, number, *sorted(channel.metadata.items()))
        if name not in self._copies:
            self._copies[name] = self._add_channel(channel.topic, channel.message_encoding, number, channel.metadata)
        return self._copies[name]

    def _schema(self, name: str, encoding: str, data: bytes) -> int:
        described = (name, encoding, data)
        number = self._schemas.get(described)
        if number is None:
            number = self._schemas[described] = self._writer.add_schema(name, encoding, data)
        return number

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
        return WriteError(f"recording {self._path}: cannot be written: {reason}{kept}", reason)


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


def own_metadata(records: Iterable[Metadata]) -> dict[str, str]:
    """Metadata that this software wrote, among those of all programs; empty if there are none."""
    return next((record.metadata for record in records if record.name == METADATA), {})


@cache
def _descriptors() -> bytes:
    proto = FileDescriptorProto()
    messages.DESCRIPTOR.CopyToProto(proto)
    return FileDescriptorSet(file=[proto]).SerializeToString()
