"""Order of the files of a recording, its plants, its times, and the errors of what it lacks."""

from pathlib import Path

import pytest

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication, encode
from reactorwatch.contract.messages_pb2 import QUALITY_GOOD, Estimate, Sample
from reactorwatch.errors import InputError
from recorder import RecordedMessage
from recorder.files.index import LATEST_NS
from recorder.files.recording import (
    Recording,
    group_overlapping,
    has_clock,
    live_file,
    merge_messages,
    open_sources,
    zero_from,
)
from recorder.files.writer import RecordingWriter


def sample(time_ns: int, plant: str = "cstr", signal: str = "T") -> RecordedMessage:
    """A sample that is received at the time of it."""
    message = encode(
        Publication(keys.key(plant, keys.SAMPLE, signal), Sample(time_ns=time_ns, value=1.0, quality=QUALITY_GOOD))
    )
    return RecordedMessage(message.key, message.payload, message.encoding, time_ns, time_ns)


def write(path: Path, *entries: RecordedMessage, metadata: dict[str, str] | None = None) -> Path:
    """A recording of these messages."""
    with RecordingWriter(path, metadata or {}) as writer:
        for entry in entries:
            writer.write(entry)
    return path


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
    estimate = encode(Publication(keys.key("west", keys.ESTIMATE, "T"), Estimate(time_ns=2)))
    other = RecordedMessage(estimate.key, estimate.payload, estimate.encoding, 2, 2)
    alone = Recording(write(tmp_path / "b.mcap", sample(1, "south"), other))
    assert alone.plants == ("south",), "one without samples is not counted"
    assert alone.one_plant() == alone.one_plant("south") == "south"
    assert alone.process(None) is None


@pytest.mark.parametrize(("count", "more"), [(5, ""), (6, " and 1 more"), (8, " and 3 more")])
def test_the_topics_of_another_program_are_named_up_to_five(tmp_path: Path, count: int, more: str) -> None:
    path = tmp_path / "a.mcap"
    with RecordingWriter(path, {}) as writer:
        for number in range(count):
            writer.write(RecordedMessage(f"topic {number}", b"x", "text" if number else "", 1, 1))
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
