"""Recordings: what is written is read back, here and by other programs; folders, plants, times and live files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.api.files import expand_folder
from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import decode, encoding_of
from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError
from reactorwatch.version import build_metadata
from recorder import RecordedMessage
from recorder.config import ReplayConfig
from recorder.files.index import LATEST_NS
from recorder.files.reader import read_start
from recorder.files.recording import (
    Recording,
    group_overlapping,
    has_clock,
    live_file,
    merge_messages,
    open_sources,
    zero_from,
)
from recorder.files.writer import METADATA, PART, RecordingWriter
from recorder.tools.convert import read_record
from recorder.tools.inspect import inspect
from recorder.tools.player import samples_of
from recorder.tools.replay import open_tape
from tests.unit.recorder import golden
from tests.unit.recorder.recording import MINUTE, SECOND, received, recorded, recorder


def sample(time_ns: int, plant: str = "cstr", signal: str = "T") -> RecordedMessage:
    """A sample that is received at the time of it."""
    message = messages.Sample(time_ns=time_ns, value=1.0, quality=messages.QUALITY_GOOD)
    return received(keys.key(plant, keys.SAMPLE, signal), message)


def write(path: Path, *entries: RecordedMessage, metadata: dict[str, str] | None = None) -> Path:
    return recorded(path, entries, metadata=metadata)


def times(entries: list[RecordedMessage]) -> list[int]:
    return [entry.log_time_ns for entry in entries]


@pytest.mark.parametrize(
    ("spans", "expected"),
    [
        ([], []),
        ([(0, 0)], [[(0, 0)]]),
        ([(1, 4), (2, 3), (3, 9), (9, 10)], [[(1, 4), (2, 3), (3, 9)], [(9, 10)]]),
        ([(1, 10), (2, 3), (4, 5)], [[(1, 10), (2, 3), (4, 5)]]),
        ([(1, 2), (2, 3), (3, 4)], [[(1, 2)], [(2, 3)], [(3, 4)]]),
        ([(0, 1), (2, 5), (3, 4)], [[(0, 1)], [(2, 5), (3, 4)]]),
    ],
)
def test_spans_that_overlap_are_one_group_and_those_that_touch_are_not(
    spans: list[tuple[int, int]], expected: list[list[tuple[int, int]]]
) -> None:
    assert group_overlapping(spans, lambda span: span) == expected


def test_files_are_in_the_order_of_their_first_messages_and_latched_ones_are_of_the_first(tmp_path: Path) -> None:
    late = write(tmp_path / "a.mcap", sample(30)._replace(latched=True), sample(31), sample(39))
    early = write(tmp_path / "b.mcap", sample(10)._replace(latched=True), sample(11), sample(35))
    sources = open_sources([late, early])
    assert [(source.path, source.span, source.first) for source in sources] == [
        (early, (10, 35), True),
        (late, (30, 39), False),
    ]
    assert times(list(Recording(tmp_path).messages())) == [10, 11, 31, 35, 39]
    assert [source.topics for source in sources] == [[("reactor/cstr/sample/T", "protobuf")] * 2] * 2


def test_files_outside_of_the_time_are_not_read(tmp_path: Path) -> None:
    sources = open_sources([write(tmp_path / f"{first}.mcap", sample(first), sample(first + 5)) for first in (10, 20)])
    for window, expected in (
        ((0, 9), []), ((0, 10), [10, 15]), ((15, 19), [10, 15]), ((16, 19), []), ((15, 20), [10, 15, 20, 25]),
        ((25, LATEST_NS), [20, 25]), ((26, LATEST_NS), []),
    ):  # fmt: skip
        assert [stored.log_time_ns for stored in merge_messages(sources, *window)] == expected


def test_a_damaged_file_is_a_source_only_where_damage_is_tolerated_and_starts_at_its_first_message(
    tmp_path: Path,
) -> None:
    whole = write(tmp_path / "whole.mcap", sample(5))
    damaged = write(tmp_path / "damaged.mcap", sample(30), sample(31))
    damaged.write_bytes(damaged.read_bytes()[:-4])
    with pytest.raises(InputError, match="is cut off"):
        open_sources([whole, damaged])
    sources = open_sources([damaged, whole], tolerant=True)
    assert [(source.path, source.span) for source in sources] == [(whole, (5, 5)), (damaged, (30, LATEST_NS))]
    assert sources[1].topics == []
    assert [stored.log_time_ns for stored in merge_messages(sources)] == [5, 30, 31]


def test_the_metadata_of_a_folder_are_those_of_its_first_file_and_those_of_each(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", sample(20), metadata={"case": "second"})
    write(tmp_path / "b.mcap", sample(10), metadata={"case": "first"})
    recording = Recording(tmp_path)
    assert recording.metadata["case"] == "first"
    assert [item["case"] for item in recording.metadata_by_file] == ["first", "second"]
    assert [record.metadata["case"] for record in recording.metadata_records] == ["first", "second"]


def test_a_folder_is_read_without_its_empty_files(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap")
    assert Recording(tmp_path).files == [tmp_path / "a.mcap"], "unless there are no others"
    write(tmp_path / "b.mcap", sample(7)._replace(latched=True), sample(8))
    assert Recording(tmp_path).files == [tmp_path / "b.mcap"]
    assert times(list(Recording(tmp_path).messages())) == [7, 8]


def test_the_plants_are_those_with_samples_and_one_of_several_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", sample(1, "south"), sample(2, "north", "C"), sample(3, "south", "C"))
    recording = Recording(path)
    assert recording.plants == ("north", "south")
    assert recording.one_plant("south") == "south"
    with pytest.raises(InputError, match="holds samples of several plants; name one of north, south"):
        recording.one_plant()
    with pytest.raises(InputError, match=r"holds no samples of plant 'east' \(there are: north, south\)"):
        recording.one_plant("east")
    assert times(list(recording.messages(plant="south"))) == [1, 3]
    assert times(list(recording.messages([keys.ALARM]))) == []
    other = received(keys.key("west", keys.ESTIMATE, "T"), messages.Estimate(time_ns=2))
    alone = Recording(write(tmp_path / "b.mcap", sample(1, "south"), other))
    assert alone.plants == ("south",), "one without samples is not counted"
    assert alone.one_plant() == alone.one_plant("south") == "south"
    assert alone.process(None) is None


@pytest.mark.parametrize(("count", "more"), [(5, ""), (6, " and 1 more"), (8, " and 3 more")])
def test_the_topics_of_another_program_are_named_up_to_five(tmp_path: Path, count: int, more: str) -> None:
    topics = (RecordedMessage(f"topic {number}", b"x", "text" if number else "", 1, 1) for number in range(count))
    path = recorded(tmp_path / "a.mcap", topics)
    own = Recording(path)
    assert own.metadata["version"]
    with pytest.raises(InputError) as raised:
        own.one_plant()
    assert str(raised.value) == f"{path}: holds no samples"
    listed = ", ".join(f"'topic {number}' ({'text' if number else 'no encoding'})" for number in range(min(count, 5)))
    error = Recording.no_samples_error(_without_metadata(own))
    assert f"another program wrote it, with topics {listed}{more}; samples are messages" in str(error)


def _without_metadata(recording: Recording) -> Recording:
    """The recording as one of another program."""
    recording._records = {file: [] for file in recording.files}
    return recording


def test_a_folder_without_a_recording_names_what_a_killed_recorder_left(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no recording \(.mcap\)$"):
        Recording(tmp_path)
    part = tmp_path / "a.mcap.part"
    part.write_bytes(write(tmp_path / "a.mcap", sample(1)).read_bytes())
    assert live_file(tmp_path) is None, "there is a complete one"
    (tmp_path / "a.mcap").unlink()
    assert live_file(tmp_path) is None, "it is not being written"
    with pytest.raises(InputError, match=r"; a.mcap.part is left of a recorder that was killed"):
        Recording(tmp_path)


def test_the_newest_file_that_is_being_written_is_the_live_one(tmp_path: Path) -> None:
    writers = [RecordingWriter(tmp_path / f"{name}.mcap", {}) for name in ("a", "b")]
    for number, writer in enumerate(writers):
        writer.write(sample(number + 1))
        writer.flush()
    assert live_file(tmp_path) == Recording(tmp_path).live == tmp_path / "b.mcap.part"
    assert times(list(Recording(tmp_path).messages())) == [2]
    assert live_file(tmp_path / "a.mcap.part") is None
    write(tmp_path / "0.mcap", sample(1))
    assert live_file(tmp_path) is None, "there is a complete one"
    for writer in writers:
        writer.abandon()


@pytest.mark.parametrize(
    ("metadata", "zero_ns", "is_clock"),
    [
        ({}, 7, True),
        ({"zero_ns": "0"}, 0, False),
        ({"zero_ns": "12"}, 12, True),
        ({"zero_ns": "soon"}, 7, True),
        ({"zero_ns": "12", "clock": "none"}, 12, False),
        ({"clock": "plant"}, 7, True),
    ],
)
def test_minutes_count_from_the_stored_zero_or_else_the_first_sample(
    metadata: dict[str, str], zero_ns: int, *, is_clock: bool
) -> None:
    assert zero_from(metadata, 7) == zero_ns
    assert has_clock(metadata) is is_clock


def sampled(
    time_ns: int, value: float = 1.0, signal: str = "T", plant: str = "cstr", received_ns: int = 0
) -> RecordedMessage:
    """A sample of a plant that samples once a minute and counts as it should."""
    message = messages.Sample(time_ns=time_ns, sequence=time_ns // MINUTE, value=value, quality=messages.QUALITY_GOOD)
    return received(keys.key(plant, keys.SAMPLE, signal), message, received_ns)


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
    path = recorded(tmp_path / "run.mcap", [sampled(1), *strange])
    assert list(Recording(path).messages())[1:] == strange
    with path.open("rb") as stream:
        factory = DecoderFactory()
        decodable = [
            factory.decoder_for(channel.message_encoding, schema) is not None
            for schema, channel, _ in make_reader(stream).iter_messages()
        ]
    assert decodable == [True, False, False]


def test_metadata_holds_the_version_and_the_given_entries(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", [], metadata={"seed": "3"})
    assert Recording(path).metadata == {**build_metadata(), "seed": "3"}


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
    entries = [sampled(number, received_ns=at) for number, at in enumerate(received)]
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


def test_a_record_has_nan_where_a_signal_was_not_measured(tmp_path: Path) -> None:
    minute = MINUTE
    bad = messages.Sample(time_ns=3 * minute, sequence=3, value=7.0, quality=messages.QUALITY_BAD)
    entries = [
        sampled(2 * minute, 20.0, received_ns=1),
        sampled(1 * minute, 10.0, received_ns=2),
        sampled(1 * minute, 1.0, "qc", received_ns=3),
        sampled(2 * minute, 99.0, received_ns=4),
        received("reactor/cstr/sample/T", bad, 5),
        sampled(3 * minute, np.inf, "C", received_ns=6),
        sampled(4 * minute, 5.0, "level", received_ns=7),
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
    path = recorded(tmp_path / "run.mcap", [sampled(1), sampled(2, 5.0, plant="b")])
    with pytest.raises(InputError, match="several plants; name one of b, cstr"):
        read_record(path)
    assert read_record(path, "b").columns["T"].tolist() == [5.0]
    with pytest.raises(InputError, match="holds no samples"):
        read_record(recorded(tmp_path / "empty.mcap", []))
    with pytest.raises(InputError, match="holds no samples of qc, C, T of plant 'cstr'"):
        read_record(recorded(tmp_path / "level.mcap", [sampled(1, signal="level")]), process=find_process())


START_NS = 1_700_000_000 * SECOND


@pytest.mark.parametrize(
    ("profile", "library", "schema", "encoding", "attachments"),
    [("", "a logger 1.2", "jsonschema", "json", ("notes.txt",)), ("ros2", "libmcap 1.4", "ros2msg", "cdr", ())],
)
def test_a_recording_of_another_program_is_described_and_what_it_lacks_is_named(
    profile: str, library: str, schema: str, encoding: str, attachments: tuple[str, ...], tmp_path: Path
) -> None:
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile=profile, library=library)
        channel = writer.register_channel("/tank/level", encoding, writer.register_schema("Level", schema, b"{}"))
        writer.add_message(channel, 1, b'{"level": 1.0}', 1)
        for name in attachments:
            writer.add_attachment(1, 1, name, "text/plain", b"hello")
        writer.finish()  # type: ignore[no-untyped-call]
    seen = inspect(path)
    assert (seen.profile, seen.library, seen.attachments, seen.metadata) == (profile, library, attachments, {})
    with pytest.raises(InputError) as caught:
        read_record(path)
    text = str(caught.value)
    assert text.count("\n") == 0
    for part in ("another program wrote it", f"'/tank/level' ({encoding})", "reactorwatch.v1.Sample", "sample/SIGNAL"):
        assert part in text


def test_a_folder_with_only_a_live_file_is_read_and_reported_as_live(tmp_path: Path) -> None:
    record = simulate_record(PlantConfig(seed=1), 100)
    fed = recorder(tmp_path, START_NS)
    fed.receive(samples_of(record, "cstr", START_NS), 2 * SECOND)
    fed.pass_time(MINUTE)
    (part,) = tmp_path.glob(f"*{PART}")
    assert not list(tmp_path.glob("*.mcap"))
    found = read_record(tmp_path)
    assert found.rows == 100
    assert found.columns["T"] == pytest.approx(record.columns["T"], rel=0, abs=0)
    assert f"{part.name}, which is still being recorded" in found.read_as
    assert inspect(tmp_path).live == part.name
    assert Recording(tmp_path).metadata["plant"] == "cstr"
    assert expand_folder(tmp_path) == [tmp_path]
    fed.kill()
    with pytest.raises(InputError, match=rf"holds no recording .*{part.name} is left of a recorder that was killed"):
        read_record(tmp_path)


def test_a_live_file_that_is_completed_while_it_is_read_is_read_to_its_end(tmp_path: Path) -> None:
    fed = recorder(tmp_path, START_NS)
    fed.receive(samples_of(simulate_record(PlantConfig(seed=1), 20), "cstr", START_NS), 2 * SECOND)
    fed.pass_time(MINUTE)
    recording = Recording(tmp_path)
    begun = len(list(recording.messages({keys.SAMPLE})))
    fed.stop()
    assert not list(tmp_path.glob(f"*{PART}"))
    assert len(list(recording.messages({keys.SAMPLE}))) == begun > 0
    assert recording.plants == ("cstr",)
    assert recording.metadata["plant"] == "cstr"
    assert METADATA in {record.name for record in recording.metadata_records}
    assert read_start(recording.files[0]).library
    (completed,) = tmp_path.glob("*.mcap")
    completed.unlink()
    with pytest.raises(InputError, match="there is no such file"):
        list(recording.messages())


def test_each_pass_of_a_loop_plays_the_files_that_the_folder_holds_then(tmp_path: Path) -> None:
    publications = list(samples_of(simulate_record(PlantConfig(seed=1), 30), "cstr", START_NS))
    third = len(publications) // 3

    def write_pass(number: int) -> Path:
        part = publications[number * third : (number + 1) * third]
        return recorded(tmp_path / f"cstr-{number}.mcap", (received(*item) for item in part))

    oldest, _ = write_pass(0), write_pass(1)
    _, tape = open_tape(ReplayConfig(file=str(tmp_path), loop=True))
    assert list(tape()) == publications[: 2 * third]
    oldest.unlink()
    write_pass(2)
    assert list(tape()) == publications[third : 3 * third]
