"""Cuts: a stretch of time out of one or several recordings; gaps are listed in the file and in what is cut from it."""

from pathlib import Path

import numpy as np
import pytest
from mcap.records import Channel as McapChannel
from mcap.records import Metadata

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, decode, encode, encoding_of
from reactorwatch.contract.messages_pb2 import QUALITY_GOOD, Sample
from reactorwatch.errors import InputError
from reactorwatch.records.record import to_time_ns
from reactorwatch.runtime.reorder_buffer import Gap
from recorder import RecordedMessage, StoredMessage
from recorder.config import RecorderConfig
from recorder.files.copies import Window, cut, recover, sample_window
from recorder.files.recording import GAP, Recording, gap_metadata, parse_gap
from recorder.files.writer import StoredChannel
from recorder.recording_files import RecordingFiles
from recorder.tools.convert import read_record
from recorder.tools.inspect import inspect
from tests.unit.recorder import golden
from tests.unit.recorder.recording import MINUTE, SECOND, Fed, received, recorded, recorder

ENTRIES = list(golden.entries())
ALWAYS = Window((0, 2**63 - 1))


def at(minutes: float) -> int:
    return to_time_ns(minutes, golden.ZERO_NS)


def test_a_cut_by_receipt_holds_what_was_received_then(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", ENTRIES, 100)
    window = Window((ENTRIES[250].log_time_ns, ENTRIES[449].log_time_ns))
    assert cut([source], tmp_path / "cut.mcap", window, {}) == 200
    kept = [entry for entry in Recording(tmp_path / "cut.mcap").messages() if not entry.latched]
    assert kept == ENTRIES[250:450]


def test_a_cut_by_sample_time_holds_the_messages_about_it_and_those_received_meanwhile(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", ENTRIES, 100)
    out = tmp_path / "cut.mcap"
    cut([source], out, sample_window([source], at(10.0), at(20.0)), {})
    kept = [entry for entry in Recording(out).messages() if not entry.latched]
    spoken = [entry for entry in ENTRIES if "/health/" not in entry.key]
    expected = [entry for entry in spoken if at(10.0) <= entry.publish_time_ns <= at(20.0)]
    assert [entry for entry in kept if "/health/" not in entry.key] == expected
    reports = [entry for entry in kept if "/health/" in entry.key]
    assert [decode(entry.payload, entry.encoding) for entry in reports] == [
        decode(entry.payload, entry.encoding)
        for entry in ENTRIES
        if "/health/" in entry.key and expected[0].log_time_ns <= entry.log_time_ns <= expected[-1].log_time_ns
    ]
    assert reports


def test_a_cut_starts_with_the_latched_messages(tmp_path: Path) -> None:
    """The fault sets in at 20 min and the alarm comes at 22: both stand when the cut begins."""
    source = recorded(tmp_path / "run.mcap", ENTRIES, 100)
    out = tmp_path / "cut.mcap"
    cut([source], out, sample_window([source], at(24.0), at(30.0)), {})
    entries = list(Recording(out).messages())
    standing = [entry for entry in entries if entry.latched]
    assert entries[: len(standing)] == standing
    assert [entry.key.split("/", 2)[2] for entry in standing] == ["fault/coolant_flow", "alarm/shewhart/T"]
    again = tmp_path / "again.mcap"
    cut([out], again, sample_window([out], at(25.0), at(26.0)), {})
    assert [entry[:3] for entry in Recording(again).messages() if entry.latched] == [entry[:3] for entry in standing]


def test_what_cannot_be_read_is_cut_out_as_it_is(tmp_path: Path) -> None:
    strange = RecordedMessage(
        "reactor/cstr/sample/T", b"\xff\xff", encoding_of(messages.Sample), ENTRIES[10].log_time_ns, 5
    )
    path = recorded(tmp_path / "run.mcap", [*ENTRIES[:10], strange])
    window = Window((ENTRIES[5].log_time_ns, strange.log_time_ns))
    cut([path], tmp_path / "cut.mcap", window, {})
    assert list(Recording(tmp_path / "cut.mcap").messages()) == [*ENTRIES[5:10], strange]


def test_no_source_is_written_over(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", ENTRIES[:50])
    with pytest.raises(InputError, match="is one of the files that are read"):
        cut([source], source, Window((0, 2**63)), {})


def test_a_damaged_source_is_reported_and_nothing_is_written(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", ENTRIES, 100)
    content = source.read_bytes()
    place = content.index(b"\x28\xb5\x2f\xfd", len(content) // 2)
    source.write_bytes(content[:place] + bytes(30) + content[place + 30 :])
    with pytest.raises(InputError, match=r"the chunk at byte \d+ .*`reactorwatch recover"):
        cut([source], tmp_path / "out.mcap", ALWAYS, {})
    source.write_bytes(content[:-1])
    with pytest.raises(InputError, match=r"is cut off.*`reactorwatch recover"):
        cut([source], tmp_path / "out.mcap", ALWAYS, {})
    assert list(tmp_path.iterdir()) == [source]


def test_a_cut_of_recordings_made_side_by_side_gives_all_in_order_of_receipt(tmp_path: Path) -> None:
    other = [entry._replace(key=entry.key.replace("cstr", "b")) for entry in ENTRIES]
    a = recorded(tmp_path / "a.mcap", ENTRIES, 100)
    b = recorded(tmp_path / "b.mcap", other, every=33)
    assert cut([b, a], tmp_path / "both.mcap", ALWAYS, {"plant": "both"}) == 2 * len(ENTRIES)
    both = list(Recording(tmp_path / "both.mcap").messages())
    assert [entry.log_time_ns for entry in both] == sorted(entry.log_time_ns for entry in (*ENTRIES, *other))
    assert [entry for entry in both if "/cstr/" in entry.key] == ENTRIES
    assert [entry for entry in both if "/b/" in entry.key] == other
    assert Recording(tmp_path / "both.mcap").plants == ("b", "cstr")
    assert Recording(tmp_path / "both.mcap").metadata["plant"] == "both"


def test_two_cuts_in_one_folder_are_read_as_the_same_record(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", ENTRIES, 100)
    (tmp_path / "parts").mkdir()
    parts: list[Path] = []
    for number, (begin, end) in enumerate(((0.0, 15.0), (15.05, 40.0))):
        parts.append(tmp_path / "parts" / f"{number}.mcap")
        cut([source], parts[-1], sample_window([source], at(begin), at(end)), {})
    first, again = read_record(source), read_record(tmp_path / "parts")
    assert np.array_equal(first.time_min, again.time_min)
    for signal in ("qc", "C", "T"):
        assert np.array_equal(first.columns[signal], again.columns[signal])
    assert [entry for entry in Recording(tmp_path / "parts").messages() if entry.latched] == []


def test_the_model_that_stands_is_that_of_the_moment_and_not_a_later_one(tmp_path: Path) -> None:
    entries = []
    for number in range(20):
        kind = messages.ModelSnapshot(time_ns=number * MINUTE, rows=number) if number % 5 == 0 else None
        sample = messages.Sample(time_ns=number * MINUTE, sequence=number, quality=messages.QUALITY_GOOD)
        for what, message in ((keys.MODEL, kind), (keys.SAMPLE, sample)):
            if message is not None:
                entries.append(received(keys.key("cstr", what, "T"), message, 10 + number * MINUTE))
    source = recorded(tmp_path / "run.mcap", entries)
    cut([source], tmp_path / "cut.mcap", sample_window([source], 12 * MINUTE, 14 * MINUTE), {})
    (standing,) = [entry for entry in Recording(tmp_path / "cut.mcap").messages() if entry.latched]
    model = decode(standing.payload, standing.encoding)
    assert isinstance(model, messages.ModelSnapshot)
    assert model.rows == 10


def stored(key: str, log_time_ns: int, publish_time_ns: int) -> StoredMessage:
    """A message of a file."""
    record = McapChannel(id=1, topic=key, message_encoding="x", metadata={}, schema_id=0)
    return StoredMessage(StoredChannel(key, "x", record=record, schema=None), 0, log_time_ns, publish_time_ns, b"")


@pytest.mark.parametrize(
    ("key", "window", "inside", "before"),
    [
        ("reactor/cstr/sample/T", Window((10, 20)), [10, 15, 20], [9]),
        ("reactor/cstr/sample/T", Window((0, 5), (10, 20)), [10, 15, 20], [9]),
        ("reactor/cstr/health/plant", Window((10, 20), (50, 60)), [10, 15, 20], [9]),
        ("of another program", Window((10, 20), (50, 60)), [10, 15, 20], [9]),
    ],
)
def test_both_ends_of_a_window_are_inside(key: str, window: Window, inside: list[int], before: list[int]) -> None:
    is_by_sample = window.sampled_ns == (10, 20)
    times = [9, 10, 15, 20, 21]
    messages = [stored(key, 3 if is_by_sample else time, time if is_by_sample else 3) for time in times]
    assert [time for time, item in zip(times, messages, strict=True) if window.side_of(item) == 0] == inside
    assert [time for time, item in zip(times, messages, strict=True) if window.side_of(item) < 0] == before


def test_of_an_empty_window_nothing_is_written(tmp_path: Path) -> None:
    source, out = recorded(tmp_path / "run.mcap", ENTRIES[:50]), tmp_path / "out.mcap"
    first_ns, last_ns = ENTRIES[0].log_time_ns, ENTRIES[49].log_time_ns
    for window in (Window((0, first_ns - 1)), Window((last_ns + 1, last_ns + 9))):
        with pytest.raises(InputError, match="holds no message of that time"):
            cut([source], out, window, {})
        assert not out.exists()
    with pytest.raises(InputError, match="there is no recording of that time; were its files deleted"):
        cut([], out, ALWAYS, {})
    with pytest.raises(InputError, match="holds no sample of that time"):
        sample_window([source], 1, 2)
    assert cut([source], out, Window((first_ns, first_ns)), {}) == 1


ALARMS = Gap("reactor/cstr/alarm", 2**64 - 1, 5, 9, 3, 20 * SECOND)


def sample(number: int) -> Publication:
    return Publication(
        keys.key("cstr", keys.SAMPLE, "T"), Sample(time_ns=number, sequence=number, quality=QUALITY_GOOD)
    )


@pytest.fixture
def fed(tmp_path: Path) -> Fed:
    """A recorder to which three alarms did not come, between two samples."""
    fed = recorder(tmp_path / "run.mcap", 10 * SECOND, black_box_min=0.0)
    fed.receive([sample(0)], SECOND)
    assert fed.node.on_gap(ALARMS, 20 * SECOND) == []
    fed.receive([sample(1)], SECOND)
    return fed


def test_a_gap_states_all_that_is_known_of_it() -> None:
    assert parse_gap(Metadata(GAP, gap_metadata(ALARMS))) == ALARMS
    assert gap_metadata(ALARMS)["noticed"] == "1970-01-01T00:00:20.000+00:00"
    assert parse_gap(Metadata(GAP, {"stream": "x"})) is None


def test_it_is_in_the_file_and_counted_as_lost(fed: Fed, tmp_path: Path) -> None:
    fed.stop()
    assert inspect(tmp_path / "run.mcap").gaps == (ALARMS,)
    assert inspect(tmp_path).gaps == (ALARMS,)
    assert fed.last_health().lost == 3


def test_samples_that_are_lost_are_counted_once_by_their_own_numbers(tmp_path: Path) -> None:
    fed = recorder(tmp_path / "run.mcap", 10 * SECOND, black_box_min=0.0)
    fed.receive([sample(0)], SECOND)
    fed.node.on_gap(Gap("reactor/cstr/sample", 1, 1, 4, 4, 20 * SECOND), 20 * SECOND)
    fed.receive([sample(5)], SECOND)
    fed.stop()
    assert fed.last_health().lost == 4


def test_recovery_and_merging_keep_it_and_a_cut_keeps_those_of_its_time(fed: Fed, tmp_path: Path) -> None:
    fed.stop()
    run = tmp_path / "run.mcap"
    (tmp_path / "cut_off.mcap").write_bytes(run.read_bytes()[:-1])
    recover(tmp_path / "cut_off.mcap", tmp_path / "saved.mcap")
    cut([run], tmp_path / "cut.mcap", Window((0, 2**63 - 1)), {})
    cut([run], tmp_path / "with.mcap", Window((11 * SECOND, 20 * SECOND)), {})
    cut([run], tmp_path / "without.mcap", Window((11 * SECOND, 19 * SECOND)), {})
    kept = {name: inspect(tmp_path / f"{name}.mcap").gaps for name in ("saved", "cut", "with", "without")}
    assert kept == {"saved": (ALARMS,), "cut": (ALARMS,), "with": (ALARMS,), "without": ()}


def test_what_the_files_before_hold_is_not_written_again_once(tmp_path: Path) -> None:
    first = recorder(tmp_path, 10 * SECOND, black_box_min=0.0)
    first.receive([sample(0), sample(1)], SECOND)
    first.stop()
    fingerprints = RecordingFiles(RecorderConfig(out=str(tmp_path))).fingerprints_since(0)
    assert len(fingerprints) == 3  # with its last report of health
    again = recorder(
        tmp_path, 30 * SECOND, fingerprints=fingerprints, fingerprints_until_ns=90 * SECOND, black_box_min=0.0
    )
    reported = [encode(item) for item in (sample(0), sample(1), sample(1), sample(2))]
    for message in reported:
        again.node.on_message(Encoded(*message[:3], 31 * SECOND), 31 * SECOND)
    path = again.files.path
    again.stop()
    assert path is not None
    assert inspect(path).overview.topics[reported[0].key].count == 2
