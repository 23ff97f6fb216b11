"""Recordings as MCAP files: https://mcap.dev/spec.

The topic of a message is its key, its log time the time of receipt, its publish time that of its sample. Messages of
ours carry their protobuf schema, so that any program reads them; a stranger's bytes are kept with the encoding that
they claimed and no schema.

Our metadata record, "reactorwatch", says which version wrote the file and what else its writer thought worth knowing;
`zero_ns` in it is the time that minutes are counted from, where that is not the first sample.
"""

from array import array
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer

from reactorwatch import __version__
from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import DecodeError, decode, encoding_of, message_type
from reactorwatch.errors import InputError
from reactorwatch.records.record import MINUTE_NS, UNITS, Record
from recorder.entry import Entry
from recorder.mcap_chunks import entries, is_in_order, metadata_records, read_summary, sorted_entries
from recorder.measurement import measured

METADATA = "reactorwatch"
ZERO_NS = "zero_ns"

_SAMPLE = encoding_of(messages.Sample)


class RecordingWriter:
    """Writes a recording: to `path + ".part"` until `close`, which gives it its name.

    Args:
        path: the file; there must be none of that name yet, finished or not.
        metadata: what the file should say about its origin, beside the version of this software.

    Raises:
        InputError: the file exists or cannot be written.
    """

    def __init__(self, path: Path, metadata: Mapping[str, str]) -> None:
        self._path = path
        self._part = path.with_name(path.name + ".part")
        self._channels: dict[tuple[str, str, bool], int] = {}
        self._schemas: dict[str, int] = {}
        check_free(path)
        try:
            self._stream = self._part.open("xb")
        except OSError as error:
            raise self._failed(error) from error
        self._writer = Writer(self._stream)
        self._writer.start(library=f"reactorwatch {__version__}")
        self._writer.add_metadata(METADATA, {"version": __version__, **metadata})
        self.flush()

    @property
    def path(self) -> Path:
        """The name that the file has once it is closed."""
        return self._path

    def write(self, entry: Entry, *, readable: bool = True) -> None:
        """Append a message.

        Args:
            entry: the message.
            readable: False keeps a payload from being given the schema that its encoding names.

        Raises:
            InputError: the file cannot be written, for lack of room perhaps.
        """
        try:
            channel = self._channels.get((entry.key, entry.encoding, readable))
            if channel is None:
                channel = self._register(entry.key, entry.encoding, readable)
            self._writer.add_message(channel, entry.log_time_ns, entry.payload, entry.publish_time_ns)
        except OSError as error:
            raise self._failed(error) from error

    def flush(self) -> None:
        """Hand everything written so far to the operating system, as chunks that are whole.

        Raises:
            InputError: the file cannot be written.
        """
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Complete the file and give it its name; a second call does nothing.

        Raises:
            InputError: the file cannot be written.
        """
        if self._stream.closed:
            return
        try:
            with self._stream:
                self._writer.finish()  # type: ignore[no-untyped-call]
            self._part.rename(self._path)
        except OSError as error:
            raise self._failed(error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _register(self, key: str, encoding: str, readable: bool) -> int:
        kind = message_type(encoding) if readable else None
        if kind is None:
            channel = self._writer.register_channel(key, encoding, schema_id=0)
        else:
            name = kind.DESCRIPTOR.full_name
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(name, SchemaEncoding.Protobuf, _descriptors())
            channel = self._writer.register_channel(key, MessageEncoding.Protobuf, self._schemas[name])
        self._channels[key, encoding, readable] = channel
        return channel

    def _failed(self, error: OSError) -> InputError:
        kept = f"; what was written is in {self._part}" if self._part.exists() else ""
        return InputError(f"recording {self._path}: cannot be written: {error.strerror}{kept}")


def check_free(path: Path) -> None:
    """See that a recording of that name can be begun.

    Raises:
        InputError: there is one, finished or not, or the folder does not exist.
    """
    part = path.with_name(path.name + ".part")
    if not path.parent.is_dir():
        raise InputError(f"recording {path}: the folder {path.parent} does not exist")
    if path.exists():
        raise InputError(f"recording {path}: exists already and is not overwritten; choose another name")
    if part.exists():
        raise InputError(
            f"recording {path}: {part} is still being written, or was left by a recorder that was killed; "
            f"`reactorwatch recover {part}` saves what is whole in it"
        )


def read_messages(path: Path, kinds: Collection[str] | None = None, plant: str | None = None) -> Iterator[Entry]:
    """The messages of a recording in the order in which they were received; those of equal time as in the file.

    Args:
        path: the file; of any size, a chunk is in memory at a time.
        kinds: only these, such as `keys.SAMPLE`; None for all, also what has no key of ours.
        plant: only those of this plant.

    Raises:
        InputError: the file is not there, is no MCAP file, or is damaged. Damage within a chunk is raised when
            the reading comes there.
    """
    summary = read_summary(path)  # not within a generator: what is wrong is raised at the call

    def wanted(key: str) -> bool:
        topic = keys.parse(key)
        if topic is None:
            return kinds is None and plant is None
        return (kinds is None or topic.kind in kinds) and (plant is None or topic.plant == plant)

    if is_in_order(summary):
        return entries(path, summary, {number for number, at in summary.channels.items() if wanted(at.topic)})
    return (entry for entry in sorted_entries(path, summary) if wanted(entry.key))


def plants_in(path: Path) -> tuple[str, ...]:
    """The plants that the recording has samples of, in alphabetical order.

    Raises:
        InputError: as `read_messages`.
    """
    summary = read_summary(path)
    found = {channel.topic for channel in summary.channels.values()}
    if not found:  # nothing was recorded, or the file's index does not say what
        found = {entry.key for entry in sorted_entries(path, summary)}
    topics = map(keys.parse, found)
    return tuple(sorted({topic.plant for topic in topics if topic is not None and topic.kind == keys.SAMPLE}))


def one_plant_in(path: Path, plant: str | None = None) -> str:
    """The plant that is asked for, or the only one there is.

    Raises:
        InputError: there are no samples, or none of this plant, or of several plants and none was named.
    """
    plants = plants_in(path)
    if not plants:
        raise InputError(f"{path}: holds no samples")
    if plant is None and len(plants) > 1:
        raise InputError(f"{path}: holds samples of several plants; name one of {', '.join(plants)}")
    if plant is not None and plant not in plants:
        raise InputError(f"{path}: holds no samples of plant {plant!r} (there are: {', '.join(plants)})")
    return plant or plants[0]


def read_metadata(path: Path) -> dict[str, str]:
    """What the recording says about its origin; empty if it is not one of ours.

    Raises:
        InputError: as `read_messages`.
    """
    return next((record.metadata for record in metadata_records(path) if record.name == METADATA), {})


def read_record(path: Path, plant: str | None = None) -> Record:
    """The samples of one plant as rows of equal sample time.

    Args:
        path: the recording.
        plant: whose samples; may be left out if there is but one plant in it.

    Returns:
        The three signals; NaN where one has no sample at a time that another has, or none that is finite and not of
        bad quality. Where a sample came twice the first counts. The time is counted from `zero_ns` of the file's
        metadata, else from the first sample.

    Raises:
        InputError: as `read_messages` and `one_plant_in`; or a sample cannot be decoded.
    """
    plant = one_plant_in(path, plant)
    series = {keys.key(plant, keys.SAMPLE, signal): (array("q"), array("d")) for signal in UNITS}
    for entry in read_messages(path, {keys.SAMPLE}, plant):
        if entry.key not in series or entry.encoding != _SAMPLE:
            continue
        try:
            sample: Any = decode(entry.payload, entry.encoding)
        except DecodeError:
            continue  # the recorder has counted it as refused
        value = measured(sample)
        if value is not None:
            times, values = series[entry.key]
            times.append(sample.time_ns)
            values.append(value)
    all_times = np.unique(np.concatenate([np.asarray(times, np.int64) for times, _ in series.values()]))
    if not all_times.size:
        raise InputError(f"{path}: holds no samples of {', '.join(UNITS)} of plant {plant!r}")
    columns = {signal: np.full(all_times.size, np.nan) for signal in UNITS}
    for column, (times, values) in zip(columns.values(), series.values(), strict=True):
        own_times, first = np.unique(np.asarray(times, np.int64), return_index=True)
        column[np.searchsorted(all_times, own_times)] = np.asarray(values)[first]
    zero_ns = int(read_metadata(path).get(ZERO_NS, all_times[0]))
    return Record(time_min=(all_times - zero_ns) / MINUTE_NS, columns=columns, name=path.name)


def _descriptors() -> bytes:
    proto = FileDescriptorProto()
    messages.DESCRIPTOR.CopyToProto(proto)
    return FileDescriptorSet(file=[proto]).SerializeToString()
