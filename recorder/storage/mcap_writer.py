"""Writing recordings as MCAP files; the bytes are those of `mcap_stream`."""

import os
from collections.abc import Callable, Iterable, Mapping
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
from recorder.message import Entry
from recorder.policy.room import MOST_CHANNELS
from recorder.storage.mcap_chunks import REPEATED
from recorder.storage.mcap_scan import Stored
from recorder.storage.mcap_stream import McapStream
from recorder.storage.part_file import PART, PartFile, is_held

METADATA = "reactorwatch"
MOST_MESSAGES = 2**32 - 1
"""The largest sequence number that a file holds; beyond it numbers start again from 0."""

_SAMPLE = encoding_of(messages.Sample)

NUMBER = "file"
"""In it: which file of its run it is, if it was written by a recorder."""


class WriteError(InputError):
    """The file takes no more; `reason` is the system's word for why."""

    def __init__(self, text: str, reason: str) -> None:
        super().__init__(text)
        self.reason = reason


class RecordingWriter:
    """Writes a recording: to `path + ".part"` until `close`, which gives it its name.

    Args:
        path: the file; there must be none of that name yet, finished or not.
        metadata: what the file should say about its origin, beside the version of this software.
        open_part: what opens the file that is written to.
        profile: that the file says its messages follow.

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
        self._copied: dict[int, tuple[Channel, int]] = {}  # by identity, which lasts because the channel is held here
        self._copies: dict[tuple[object, ...], int] = {}
        check_free(path)
        try:
            self._stream = open_part(self._part)
        except OSError as error:
            raise self._failed(error) from error
        self._writer = McapStream(self._stream)
        try:
            self._writer.start(f"reactorwatch {__version__}", profile)
            self._writer.add_metadata(METADATA, {"version": __version__, **metadata})
            self._stream.flush()
        except OSError as error:
            self._stream.abandon()
            self._part.unlink(missing_ok=True)  # nothing is in it
            raise self._failed(error) from error

    @property
    def path(self) -> Path:
        """The name that the file has once it is closed."""
        return self._path

    @property
    def size_bytes(self) -> int:
        """What the file holds so far, without the chunk that is being gathered."""
        return self._stream.tell()

    def write(self, entry: Entry, *, readable: bool = True) -> None:
        """Append a message; a sample's number is its sequence number in the file.

        Args:
            entry: the message.
            readable: False keeps a payload from being given the schema that its encoding names.

        Raises:
            WriteError: the file cannot be written, for lack of room perhaps.
        """
        try:
            name = (entry.key, entry.encoding, readable, entry.repeated)
            channel = self._channels.get(name)
            if channel is None:
                channel = self._channels[name] = self._register(entry, readable=readable)
            number = read_sequence(entry.payload) & MOST_MESSAGES if readable and entry.encoding == _SAMPLE else 0
            self._writer.add_message(channel, entry.log_time_ns, entry.payload, entry.publish_time_ns, number)
        except OSError as error:
            raise self._failed(error) from error

    def copy(self, stored: Stored) -> None:
        """Append a message of another file as it is, its channel described as there.

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
            raise self._failed(error) from error

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Append what a program says about the file.

        Raises:
            WriteError: as `write`.
        """
        try:
            self._writer.flush()
            self._writer.add_metadata(name, metadata)
        except OSError as error:
            raise self._failed(error) from error

    def add_attachment(self, attachment: Attachment) -> None:
        """Append a file that belongs to the recording.

        Raises:
            WriteError: as `write`.
        """
        try:
            self._writer.flush()
            self._writer.add_attachment(attachment)
        except OSError as error:
            raise self._failed(error) from error

    def flush(self) -> None:
        """Hand everything written so far to the operating system, as chunks that are whole.

        Raises:
            WriteError: the file cannot be written.
        """
        try:
            self._writer.flush()
        except OSError as error:
            raise self._failed(error) from error

    def sync(self) -> None:
        """Wait until what was flushed is on the disk.

        Raises:
            WriteError: the file cannot be written.
        """
        try:
            self._stream.sync()
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Complete the file and give it its name; a second call does nothing.

        Raises:
            WriteError: the file cannot be written; what was flushed is kept under the name it had.
        """
        if self._stream.closed:
            return
        try:
            self._writer.finish()
            self._stream.finish(self._path)
        except OSError as error:
            raise self._failed(error) from error
        finally:
            self._stream.abandon()

    def abandon(self) -> None:
        """Leave the file as it was when it was last flushed, to be recovered; after `close` it does nothing."""
        self._stream.abandon()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _register(self, entry: Entry, *, readable: bool) -> int:
        metadata = {REPEATED: "true"} if entry.repeated else {}
        kind = message_type(entry.encoding) if readable else None
        if kind is None:
            return self._add_channel(entry.key, entry.encoding, 0, metadata)
        schema = self._schema(kind.DESCRIPTOR.full_name, SchemaEncoding.Protobuf, _descriptors())
        return self._add_channel(entry.key, MessageEncoding.Protobuf, schema, metadata)

    def _add_channel(self, topic: str, encoding: str, schema: int, metadata: dict[str, str]) -> int:
        """Describe a channel, if the format has a number left for it."""
        if self._writer.channel_count >= MOST_CHANNELS:
            reason = f"a file has room for {MOST_CHANNELS} keys, and {topic!r} is one more"
            raise WriteError(f"recording {self._path}: {reason}", reason)
        return self._writer.add_channel(topic, encoding, schema, metadata)

    def _copied_channel(self, stored: Stored) -> int:
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

    def _failed(self, error: OSError) -> WriteError:
        kept = f"; what was written is in {self._part}" if self._part.exists() else ""
        reason = error.strerror or type(error).__name__
        return WriteError(f"recording {self._path}: cannot be written: {reason}{kept}", reason)


def part_of(path: Path) -> Path:
    """The name that a recording has until it is whole."""
    return path.with_name(path.name + PART)


def check_free(path: Path) -> None:
    """See that a recording of that name can be begun.

    Raises:
        InputError: there is one, finished or not, or the folder does not exist.
    """
    part = part_of(path)
    if not path.parent.is_dir():
        raise InputError(f"recording {path}: the folder {path.parent} does not exist")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"recording {path}: the folder {path.parent} cannot be written to")
    if path.exists():
        raise InputError(f"recording {path}: exists already and is not overwritten; choose another name")
    if is_held(part):
        raise InputError(f"recording {path}: {part} is being written by another recorder; choose another name")
    if part.exists():
        raise InputError(
            f"recording {path}: {part} was left by a recorder that was killed; "
            f"`reactorwatch recover {part}` saves what is whole in it"
        )


def own_metadata(records: Iterable[Metadata]) -> dict[str, str]:
    """What this software wrote about the origin of a file, among all that programs did; empty if it wrote nothing."""
    return next((record.metadata for record in records if record.name == METADATA), {})


@cache
def _descriptors() -> bytes:
    proto = FileDescriptorProto()
    messages.DESCRIPTOR.CopyToProto(proto)
    return FileDescriptorSet(file=[proto]).SerializeToString()
