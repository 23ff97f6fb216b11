"""The overview of a recording."""

from collections import Counter
from pathlib import Path

from reactorwatch.cli.info import info_object
from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from recorder import RecordedMessage
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter
from recorder.tools.inspect import FileInfo, MissingSamples, inspect, overview, zero_ns_of
from tests.unit.recorder import golden
from tests.unit.recorder.recording import SECOND, received

KEY = "reactor/cstr/sample/T"


def sampled(*sequences: int) -> list[RecordedMessage]:
    """Samples that were taken a second apart, by their number, and received in this order."""
    return [
        received(
            KEY, messages.Sample(time_ns=1000 + number * SECOND, sequence=number, quality=messages.QUALITY_GOOD), place
        )
        for place, number in enumerate(sequences, start=1)
    ]


def alarm(
    at: int, event: str, raised: int, cleared: int = 0, *, latched: bool = False, plant: str = "cstr"
) -> RecordedMessage:
    key = keys.key(plant, keys.ALARM, "ewma/T")
    message = messages.Alarm(time_ns=at, alarm="ewma/T", event=event, raised_ns=raised, cleared_ns=cleared)
    return received(key, message, at, latched=latched)


def test_counts_and_times_are_those_of_the_entries() -> None:
    entries = list(golden.entries())
    seen = overview(entries)
    assert {key: topic.count for key, topic in seen.topics.items()} == Counter(entry.key for entry in entries)
    assert (seen.first_ns, seen.last_ns) == (entries[0].log_time_ns, entries[-1].log_time_ns)
    assert seen.sample_span_ns == (golden.time_ns(0), golden.time_ns(golden.ROWS - 1))
    assert (seen.messages, seen.lost, seen.gaps) == (len(entries), 0, [])


def test_gaps_are_named_by_the_numbers_that_are_missing() -> None:
    seen = overview(sampled(0, 1, 2, 5, 6, 10))
    after = [1000 + 2 * SECOND, 1000 + 6 * SECOND]
    assert seen.gaps == [MissingSamples(KEY, 3, 4, after[0]), MissingSamples(KEY, 7, 9, after[1])]
    assert seen.lost == 5


def test_what_came_late_is_not_missing() -> None:
    seen = overview(sampled(0, 5, 3, 9, 1))
    assert [(gap.first, gap.last) for gap in seen.gaps] == [(2, 2), (4, 4), (6, 8)]
    assert (seen.lost, seen.out_of_order) == (5, 2)


def test_repeated_messages_are_not_counted_but_show_an_active_alarm() -> None:
    seen = overview([alarm(10, "raised", 10, latched=True), *sampled(0, 1), alarm(30, "cleared", 10, 30)])
    assert seen.messages == 3
    assert [(item.raised_ns, item.cleared_ns) for item in seen.alarms] == [(10, 30)]


def test_alarms_of_one_name_in_two_plants_end_on_their_own() -> None:
    seen = overview(
        [
            alarm(10, "raised", 10),
            alarm(20, "raised", 20, plant="other"),
            alarm(30, "cleared", 10, 30),
            alarm(40, "cleared", 20, 40, plant="other"),
        ]
    )
    assert [(item.raised_ns, item.cleared_ns) for item in seen.alarms] == [(10, 30), (20, 40)]


def test_alarms_are_listed_with_their_ends() -> None:
    seen = overview(
        [
            alarm(10, "raised", 10),
            alarm(12, "suspected", 10),
            alarm(15, "acknowledge", 10),
            alarm(20, "cleared", 10, 20),
            alarm(30, "raised", 30),
        ]
    )
    assert [(item.alarm, item.raised_ns, item.cleared_ns) for item in seen.alarms] == [
        ("ewma/T", 10, 20),
        ("ewma/T", 30, None),
    ]


def test_a_file_that_is_cut_off_is_looked_over_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    entries = list(golden.entries())
    with RecordingWriter(path, {"plant": "cstr", "seed": "5"}) as writer:
        for number, item in enumerate(entries, start=1):
            writer.write(item)
            if number == 1000:
                writer.flush()
                half = (tmp_path / "run.mcap.part").stat().st_size
    whole = inspect(path)
    assert (whole.overview.messages, whole.damages, whole.metadata["seed"]) == (len(entries), (), "5")
    assert whole.zero_ns == zero_ns_of(Recording(path)) == golden.ZERO_NS
    assert inspect(tmp_path).overview == whole.overview
    path.write_bytes(path.read_bytes()[:half])
    cut_off = inspect(path)
    assert cut_off.overview.messages == 1000
    assert cut_off.damages == (f"cut off at byte {half}",)


def test_a_sample_at_time_0_is_a_sample() -> None:
    """Alone, or among others before and after it."""
    at = [
        messages.Sample(time_ns=time_ns, sequence=n, quality=messages.QUALITY_GOOD)
        for n, time_ns in enumerate((-SECOND, 0, SECOND))
    ]
    entries = [received(KEY, item, 1) for item in at]
    assert overview(entries[1:2]).sample_span_ns == (0, 0)
    assert overview(entries).sample_span_ns == (-SECOND, SECOND)
    assert overview([]).sample_span_ns is None
    stated = info_object(FileInfo(overview(entries[1:2]), {"zero_ns": "0"}, 0, ()), Path("x.mcap"))
    assert (stated["from_min"], stated["to_min"], stated["zero"]) == (0.0, 0.0, None)
    assert info_object(FileInfo(overview([]), {}, 0, ()), Path("x.mcap"))["from_min"] is None
