"""Recordings out of recordings: a stretch of time, and several as one."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.records import Channel as McapChannel

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Publication, decode, encode, encoding_of
from reactorwatch.errors import InputError
from reactorwatch.records.record import to_time_ns
from recorder import RecordedMessage, StoredMessage
from recorder.files.copies import RecoveryResult, Window, cut, recover, sample_window
from recorder.files.reader import Damage, StoredChannel, metadata_records
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter
from recorder.tools.convert import read_record
from tests.unit.recorder import golden

MINUTE = 60_000_000_000
ENTRIES = list(golden.entries())
ALWAYS = Window((0, 2**63 - 1))


def recorded(
    path: Path, entries: list[RecordedMessage], every: int = 100, metadata: dict[str, str] | None = None
) -> Path:
    with RecordingWriter(path, metadata or {}) as writer:
        for number, entry in enumerate(entries, start=1):
            writer.write(entry)
            if number % every == 0:
                writer.flush()
    return path


def at(minutes: float) -> int:
    return to_time_ns(minutes, golden.ZERO_NS)


def test_a_cut_by_receipt_holds_what_was_received_then(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", ENTRIES)
    window = Window((ENTRIES[250].log_time_ns, ENTRIES[449].log_time_ns))
    assert cut([source], tmp_path / "cut.mcap", window, {}) == 200
    kept = [entry for entry in Recording(tmp_path / "cut.mcap").messages() if not entry.latched]
    assert kept == ENTRIES[250:450]


def test_a_cut_by_sample_time_holds_the_messages_about_it_and_those_received_meanwhile(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", ENTRIES)
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
    source = recorded(tmp_path / "run.mcap", ENTRIES)
    out = tmp_path / "cut.mcap"
    cut([source], out, sample_window([source], at(24.0), at(30.0)), {})
    entries = list(Recording(out).messages())
    standing = [entry for entry in entries if entry.latched]
    assert entries[: len(standing)] == standing
    assert [entry.key.split("/", 2)[2] for entry in standing] == ["fault/coolant_flow", "alarm/shewhart/T"]
    again = tmp_path / "again.mcap"
    cut([out], again, sample_window([out], at(25.0), at(26.0)), {})
    assert [entry[:3] for entry in Recording(again).messages() if entry.latched] == [entry[:3] for entry in standing]


def test_a_cut_of_several_files_goes_across_them(tmp_path: Path) -> None:
    halves = [recorded(tmp_path / "b.mcap", ENTRIES[800:]), recorded(tmp_path / "a.mcap", ENTRIES[:800])]
    window = Window((ENTRIES[700].log_time_ns, ENTRIES[899].log_time_ns))
    assert cut(halves, tmp_path / "cut.mcap", window, {}) == 200
    assert [entry for entry in Recording(tmp_path / "cut.mcap").messages() if not entry.latched] == ENTRIES[700:900]


def test_what_cannot_be_read_is_cut_out_as_it_is(tmp_path: Path) -> None:
    strange = RecordedMessage(
        "reactor/cstr/sample/T", b"\xff\xff", encoding_of(messages.Sample), ENTRIES[10].log_time_ns, 5
    )
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, {}) as writer:
        for entry in ENTRIES[:10]:
            writer.write(entry)
        writer.write(strange, readable=False)
    window = Window((ENTRIES[5].log_time_ns, strange.log_time_ns))
    cut([path], tmp_path / "cut.mcap", window, {})
    assert list(Recording(tmp_path / "cut.mcap").messages()) == [*ENTRIES[5:10], strange]


def test_where_nothing_was_received_no_file_is_written(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", ENTRIES[:50])
    with pytest.raises(InputError, match="holds no message of that time"):
        cut([source], tmp_path / "cut.mcap", Window((0, 10)), {})
    with pytest.raises(InputError, match="holds no sample of that time"):
        sample_window([source], at(500.0), at(600.0))
    assert list(tmp_path.iterdir()) == [source]


def test_no_source_is_written_over(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", ENTRIES[:50])
    with pytest.raises(InputError, match="is one of the files that are read"):
        cut([source], source, Window((0, 2**63)), {})


def test_a_damaged_source_is_reported_and_nothing_is_written(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", ENTRIES)
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
    a = recorded(tmp_path / "a.mcap", ENTRIES)
    b = recorded(tmp_path / "b.mcap", other, every=33)
    assert cut([b, a], tmp_path / "both.mcap", ALWAYS, {"plant": "both"}) == 2 * len(ENTRIES)
    both = list(Recording(tmp_path / "both.mcap").messages())
    assert [entry.log_time_ns for entry in both] == sorted(entry.log_time_ns for entry in (*ENTRIES, *other))
    assert [entry for entry in both if "/cstr/" in entry.key] == ENTRIES
    assert [entry for entry in both if "/b/" in entry.key] == other
    assert Recording(tmp_path / "both.mcap").plants == ("b", "cstr")
    assert Recording(tmp_path / "both.mcap").metadata["plant"] == "both"


def test_two_cuts_in_one_folder_are_read_as_the_same_record(tmp_path: Path) -> None:
    source = recorded(tmp_path / "run.mcap", ENTRIES)
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
                encoded = encode(Publication(keys.key("cstr", what, "T"), message))
                entries.append(RecordedMessage(*encoded[:3], 10 + number * MINUTE, number * MINUTE))
    source = recorded(tmp_path / "run.mcap", entries, every=1000)
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
    assert [time for time, item in zip(times, messages, strict=True) if window.contains(item)] == inside
    assert [time for time, item in zip(times, messages, strict=True) if window.starts_after(item)] == before


def test_the_losses_of_a_recovery_are_named_up_to_five_places() -> None:
    damages = tuple(Damage(at, "a chunk") for at in range(7))
    assert RecoveryResult(1, 1, 1, {}, (), 0).losses == ""
    assert RecoveryResult(1, 1, 1, {}, damages[:2], 3).losses == (
        "a chunk at byte 0; a chunk at byte 1; 3 messages of channels that are described nowhere"
    )
    assert "more places" not in RecoveryResult(1, 1, 1, {}, damages[:5], 0).losses
    assert RecoveryResult(1, 1, 1, {}, damages, 0).losses.endswith("a chunk at byte 4; 2 more places")


def test_a_recovery_that_lost_nothing_but_the_end_is_only_truncated() -> None:
    end, chunk = Damage(9, "cut off", is_end=True), Damage(3, "a chunk")
    for damages, orphans, expected in (
        ((), 0, True), ((end,), 0, True), ((chunk, end), 0, False), ((end,), 1, False),
    ):  # fmt: skip
        assert RecoveryResult(1, 1, 1, {}, damages, orphans).is_only_truncated is expected


def test_a_recovery_counts_topics_and_times_and_dates_the_file_by_its_last_message(tmp_path: Path) -> None:
    source, out = recorded(tmp_path / "run.mcap", ENTRIES[:50]), tmp_path / "out.mcap"
    saved = recover(source, out)
    times = [entry.log_time_ns for entry in ENTRIES[:50]]
    assert (saved.messages, saved.first_ns, saved.last_ns) == (50, times[0], times[-1])
    assert saved.topics == Counter(entry.key for entry in ENTRIES[:50])
    assert out.stat().st_mtime_ns == times[-1]
    assert [record.name for record in metadata_records(out)] == ["reactorwatch"]


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
