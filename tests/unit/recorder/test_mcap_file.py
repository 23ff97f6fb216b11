"""Recordings: what is written is read back, here and by others."""

import resource
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Publication, decode, encode, encoding_of
from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError
from reactorwatch.version import build_metadata
from recorder import RecordedMessage
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter
from recorder.tools.convert import read_record
from tests.unit.recorder import golden


def recorded(path: Path, entries: list[RecordedMessage], every: int = 0) -> Path:
    """A recording, flushed after each so many entries."""
    with RecordingWriter(path, {"seed": "3"}) as writer:
        for number, entry in enumerate(entries, start=1):
            writer.write(entry)
            if every and number % every == 0:
                writer.flush()
    return path


MINUTE = 60_000_000_000


def sample(
    time_ns: int, value: float = 1.0, signal: str = "T", plant: str = "cstr", received_ns: int = 0
) -> RecordedMessage:
    """A sample of a plant that samples once a minute and counts as it should."""
    message = messages.Sample(time_ns=time_ns, sequence=time_ns // MINUTE, value=value, quality=messages.QUALITY_GOOD)
    encoded = encode(Publication(keys.key(plant, keys.SAMPLE, signal), message))
    return RecordedMessage(encoded.key, encoded.payload, encoded.encoding, received_ns or time_ns, time_ns)


@pytest.mark.parametrize("every", [0, 100])
def test_every_entry_comes_back_in_the_order_of_receipt(tmp_path: Path, every: int) -> None:
    entries = list(golden.entries())
    assert list(Recording(recorded(tmp_path / "run.mcap", entries, every)).messages()) == entries


def test_other_software_reads_the_same_values_by_the_schemas_in_the_file(tmp_path: Path) -> None:
    """mcap-protobuf-support knows nothing of ours: it builds the classes from the file alone."""
    entries = list(golden.entries())
    path = recorded(tmp_path / "run.mcap", entries)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        theirs = list(reader.iter_decoded_messages())
    assert len(theirs) == len(entries)
    for (schema, channel, message, decoded), entry in zip(theirs, entries, strict=True):
        ours = decode(entry.payload, entry.encoding)
        assert schema is not None
        assert (schema.name, schema.encoding) == (ours.DESCRIPTOR.full_name, "protobuf")
        assert (channel.topic, channel.message_encoding) == (entry.key, "protobuf")
        assert (message.log_time, message.publish_time) == (entry.log_time_ns, entry.publish_time_ns)
        assert str(decoded) == str(ours)


def test_foreign_bytes_are_kept_with_their_stated_encoding_and_no_schema(tmp_path: Path) -> None:
    strange = [
        RecordedMessage("reactor/cstr/sample/T", b"{}", "application/json", 1, 1),
        RecordedMessage("reactor/cstr/sample/T", b"\xff\xff", encoding_of(messages.Sample), 2, 2),
    ]
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, {}) as writer:
        writer.write(sample(1))
        for entry in strange:
            writer.write(entry)
    assert list(Recording(path).messages())[1:] == strange
    with path.open("rb") as stream:
        factory = DecoderFactory()
        decodable = [
            factory.decoder_for(channel.message_encoding, schema) is not None
            for schema, channel, _ in make_reader(stream).iter_messages()
        ]
    assert decodable == [True, False, False]


def test_metadata_holds_the_version_and_the_given_entries(tmp_path: Path) -> None:
    assert Recording(recorded(tmp_path / "run.mcap", [])).metadata == {**build_metadata(), "seed": "3"}


def test_a_recording_of_nothing_is_a_recording(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", [])
    assert list(Recording(path).messages()) == []
    assert Recording(path).plants == ()


def test_reading_can_be_limited_to_kinds_and_to_a_plant(tmp_path: Path) -> None:
    entries = [*golden.entries(), *(entry._replace(key=entry.key.replace("cstr", "b")) for entry in golden.entries())]
    entries.append(RecordedMessage("reactor/odd", b"", "?", entries[-1].log_time_ns, 0))
    path = recorded(tmp_path / "run.mcap", entries)
    alarms = list(Recording(path).messages({keys.ALARM, keys.FAULT}, "b"))
    assert {entry.key for entry in alarms} == {"reactor/b/alarm/shewhart/T", "reactor/b/fault/coolant_flow"}
    assert len(alarms) == 3
    assert len(list(Recording(path).messages({keys.SAMPLE}))) == 2 * 3 * golden.ROWS
    assert len(list(Recording(path).messages(plant="b"))) == len(list(golden.entries()))
    assert Recording(path).plants == ("b", "cstr")


@pytest.mark.parametrize("every", [0, 1, 3], ids=["in a chunk", "between chunks", "both"])
def test_what_is_not_in_order_in_the_file_is_read_in_order_of_receipt(tmp_path: Path, every: int) -> None:
    """Equal times stay as they are in the file. The library's own order is the truth here."""
    received = [5, 3, 3, 9, 1, 5, 7, 2, 9, 8]
    entries = [sample(number, received_ns=at) for number, at in enumerate(received)]
    path = recorded(tmp_path / "run.mcap", entries, every)
    assert list(Recording(path).messages()) == sorted(entries, key=lambda entry: entry.log_time_ns)


@pytest.mark.parametrize(
    "options",
    [{"use_chunking": False}, {"repeat_channels": False}, {"repeat_schemas": False}, {"enable_crcs": False}],
    ids=lambda options: next(iter(options)),
)
def test_files_that_other_programs_write_in_another_way_are_read_as_well(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    path = tmp_path / "run.mcap"
    entries = list(golden.entries())
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start()
        schema = writer.register_schema("reactorwatch.v1.Sample", "protobuf", b"")
        channels = {entry.key: writer.register_channel(entry.key, "protobuf", schema) for entry in entries}
        for entry in entries:
            writer.add_message(channels[entry.key], entry.log_time_ns, entry.payload, entry.publish_time_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    sampled = [entry for entry in entries if keys.SAMPLE in entry.key]
    assert list(Recording(path).messages({keys.SAMPLE})) == sampled
    assert Recording(path).plants == ("cstr",)
    assert Recording(path).metadata == {}


def test_records_that_are_private_to_another_program_are_passed_over(tmp_path: Path) -> None:
    """In a file without chunks: https://mcap.dev/spec#records leaves opcodes from 0x80 on to applications."""
    path = tmp_path / "run.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start()
        channel = writer.register_channel("/x", "json", 0)
        writer.add_message(channel, 2, b"{}", 2)
        stream.write(b"\x85" + (3).to_bytes(8, "little") + b"abc")
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()  # type: ignore[no-untyped-call]
    assert [entry.log_time_ns for entry in Recording(path).messages()] == [1, 2]


def test_a_recording_is_never_written_over(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", [])
    with pytest.raises(InputError, match=r"run.mcap: exists already and is not overwritten"):
        RecordingWriter(path, {})
    path.rename(tmp_path / "other.mcap.part")
    with pytest.raises(InputError, match=r"recover .*other.mcap.part"):
        RecordingWriter(tmp_path / "other.mcap", {})
    with pytest.raises(InputError, match=r"the folder .+ does not exist"):
        RecordingWriter(tmp_path / "no" / "run.mcap", {})


def test_the_file_gets_its_name_when_it_is_closed(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap", {})
    writer.write(sample(1))
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap.part"]
    writer.close()
    writer.close()
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_what_was_flushed_is_on_its_way_to_the_disk(tmp_path: Path) -> None:
    """The file as another process sees it grows by a flush, and not by a second one with nothing new."""
    part = tmp_path / "run.mcap.part"
    with RecordingWriter(tmp_path / "run.mcap", {}) as writer:
        writer.write(sample(1))
        sizes = [part.stat().st_size]
        for _ in range(2):
            writer.flush()
            sizes.append(part.stat().st_size)
    assert sizes[0] < sizes[1] == sizes[2]


def test_a_full_disk_is_reported_in_one_line(tmp_path: Path) -> None:
    """A limit on the size of files stands for the full disk: the system refuses the write in the same way."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = RecordingWriter(tmp_path / "run.mcap", {})
    writer.write(sample(1)._replace(payload=np.random.default_rng(1).bytes(100_000)))
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(
            InputError, match=r"run.mcap: cannot be written: .*; what was written is in .*run.mcap.part"
        ):
            writer.flush()
        with pytest.raises(InputError, match="cannot be written"):
            writer.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap.part"]


def test_a_record_holds_the_samples_by_time(tmp_path: Path) -> None:
    record = read_record(recorded(tmp_path / "run.mcap", list(golden.entries())))
    assert record.time_min.tolist() == [row * 6 / 60 for row in range(golden.ROWS)]
    for signal in ("qc", "C", "T"):
        assert record.columns[signal].tolist() == [golden.value(signal, row) for row in range(golden.ROWS)]


def test_a_record_has_nan_where_a_signal_was_not_measured(tmp_path: Path) -> None:
    minute = MINUTE
    bad = messages.Sample(time_ns=3 * minute, sequence=3, value=7.0, quality=messages.QUALITY_BAD)
    encoded = encode(Publication("reactor/cstr/sample/T", bad))
    entries = [
        sample(2 * minute, 20.0, received_ns=1),
        sample(1 * minute, 10.0, received_ns=2),
        sample(1 * minute, 1.0, "qc", received_ns=3),
        sample(2 * minute, 99.0, received_ns=4),
        RecordedMessage(encoded.key, encoded.payload, encoded.encoding, 5, 3 * minute),
        sample(3 * minute, np.inf, "C", received_ns=6),
        sample(4 * minute, 5.0, "level", received_ns=7),
        RecordedMessage("reactor/cstr/sample/T", b"", encoding_of(messages.Sample), 8, 8),
    ]
    record = read_record(recorded(tmp_path / "run.mcap", entries))
    assert record.time_min.tolist() == [0.0, 1.0, 2.0, 3.0]
    nan = np.nan
    assert np.array_equal(record.columns["T"], [10.0, 20.0, nan, nan], equal_nan=True)
    assert np.array_equal(record.columns["qc"], [1.0, nan, nan, nan], equal_nan=True)
    assert np.array_equal(record.columns["C"], [nan, nan, nan, nan], equal_nan=True)
    assert np.array_equal(record.columns["level"], [nan, nan, nan, 5.0], equal_nan=True)


def test_a_record_is_of_one_plant(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", [sample(1), sample(2, 5.0, plant="b")])
    with pytest.raises(InputError, match="several plants; name one of b, cstr"):
        read_record(path)
    with pytest.raises(InputError, match=r"no samples of plant 'c' \(there are: b, cstr\)"):
        read_record(path, "c")
    assert read_record(path, "b").columns["T"].tolist() == [5.0]
    with pytest.raises(InputError, match="holds no samples"):
        read_record(recorded(tmp_path / "empty.mcap", []))
    with pytest.raises(InputError, match="holds no samples of qc, C, T of plant 'cstr'"):
        read_record(recorded(tmp_path / "level.mcap", [sample(1, signal="level")]), process=find_process())


def test_the_file_s_sequence_numbers_are_those_of_the_samples(tmp_path: Path) -> None:
    """Read by the bare MCAP library; what is no sample has none, and neither has what cannot be read."""
    late = messages.Sample(time_ns=1, sequence=2**32 + 7, quality=messages.QUALITY_GOOD)
    encoded = encode(Publication("reactor/cstr/sample/T", late))
    entries = [*golden.entries(), RecordedMessage(*encoded[:3], 2**62, 1)]
    path = recorded(tmp_path / "run.mcap", entries)
    with path.open("rb") as stream:
        found = [(channel.topic, message.sequence) for _, channel, message in make_reader(stream).iter_messages()]
    expected = [
        (entry.key, body.sequence % 2**32 if isinstance(body, messages.Sample) else 0)
        for entry in entries
        for body in [decode(entry.payload, entry.encoding)]
    ]
    assert found == expected
    assert len({number for topic, number in found if topic.endswith("sample/T")}) > golden.ROWS - 1
