"""Messages as the recorder stores them."""

import os
from pathlib import Path

import pytest

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Body, Encoded, Publication, encode, encode_message, encoding_of
from reactorwatch.runtime.reorder_buffer import Gap
from recorder import RecordedMessage
from recorder.core import DISK_ALARM, KEYS_ALARM, Recorder, fingerprint

KEY = "reactor/cstr/sample/T"
GOOD = messages.QUALITY_GOOD


def encoded(message: Body, key: str = KEY, received_ns: int = 0) -> Encoded:
    return encode(Publication(key, message))._replace(received_ns=received_ns)


def health(recorder: Recorder, now_ns: int = 1000) -> messages.Health:
    message = recorder.health(now_ns).message
    assert isinstance(message, messages.Health)
    return message


def test_an_entry_has_the_time_of_receipt_and_that_of_its_sample() -> None:
    message = encoded(messages.Sample(time_ns=77, value=1.0, quality=GOOD), received_ns=500)
    kept = Recorder("cstr", 0).on_message(message, 600)
    assert kept is not None
    assert kept.channel.is_readable
    assert kept.recorded_message == RecordedMessage(KEY, message.payload, encoding_of(messages.Sample), 500, 77)


def test_without_a_time_of_receipt_it_is_the_moment_of_the_work() -> None:
    kept = Recorder("cstr", 0).on_message(encoded(messages.Sample(time_ns=77, quality=GOOD)), 600)
    assert kept is not None
    assert kept.recorded_message.log_time_ns == 600


def test_the_time_of_receipt_never_runs_backwards() -> None:
    recorder = Recorder("cstr", 100)
    received = [
        recorder.on_message(encoded(messages.Sample(quality=GOOD), received_ns=at), at) for at in (300, 200, 400)
    ]
    assert [kept.recorded_message.log_time_ns for kept in received if kept] == [300, 300, 400]


def test_what_cannot_be_read_is_kept_as_it_is_and_counted_by_reason() -> None:
    recorder = Recorder("cstr", 0)
    strange = [
        Encoded("reactor/cstr/sample/T", b"{}", "application/json"),
        Encoded("reactor/cstr/sample/T", b"\xff\xff", encoding_of(messages.Sample)),
        Encoded("reactor/cstr", *encode_message(messages.Sample(quality=GOOD))),
        Encoded("reactor/cstr/sample/T", *encode_message(messages.Sample(time_ns=-1, quality=GOOD))),
        Encoded("reactor/cstr/sample/T", b"", encoding_of(messages.Sample)),
    ]
    kept = [recorder.on_message(message, 50) for message in strange]
    assert [item is not None and item.channel.is_readable for item in kept] == [False, False, True, True, True]
    for message, item in zip(strange, kept, strict=True):
        assert item is not None
        assert item.recorded_message[:3] == message[:3]
    assert [item.recorded_message.publish_time_ns for item in kept if item] == [50, 50, 0, 50, 0]
    report = health(recorder)
    assert dict(report.refused_by_reason) == {"encoding": 1, "payload": 2, "key": 1, "time": 1}
    assert (report.refused, report.received) == (5, 5)


def test_the_counts_of_keys_that_are_followed_no_longer_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recorder.core.MAX_COUNTERS", 3)
    recorder = Recorder("cstr", 0)
    for number in range(10):
        for sequence in (0, 2, 2):
            sample = messages.Sample(sequence=sequence, time_ns=sequence, quality=GOOD)
            recorder.on_message(encoded(sample, f"reactor/p{number}/sample/T"), 0)
    report = health(recorder)
    assert (report.lost, report.duplicated) == (10, 10)


def test_health_reports_losses_by_key() -> None:
    recorder = Recorder("cstr", 0)
    for key, sequences in (("reactor/cstr/sample/T", (0, 1, 5)), ("reactor/cstr/sample/C", (0, 1, 1, 3, 2))):
        for sequence in sequences:
            recorder.on_message(encoded(messages.Sample(sequence=sequence, time_ns=sequence, quality=GOOD), key), 0)
    report = health(recorder)
    assert (report.lost, report.duplicated, report.out_of_order, report.received) == (3, 1, 1, 8)


def test_samples_of_an_earlier_file_are_not_lost_and_their_lag_is_reported() -> None:
    """The recorder before had a gap of two; the history of this one holds them, and what was recorded before it."""
    history = [
        encoded(messages.Sample(sequence=number, time_ns=number, quality=GOOD), received_ns=1) for number in range(7)
    ]
    recorded = {fingerprint(item.key, item.payload) for number, item in enumerate(history) if number not in (2, 3, 6)}
    recorder = Recorder("cstr", 0, recorded, fingerprints_until_ns=10_000_000)
    received = [recorder.on_message(item, 5_000_001) for item in history]
    assert [item.sequence for item in received if item is not None] == [2, 3, 6]
    report = health(recorder)
    assert (report.lost, report.out_of_order, report.received, report.lag_ms) == (0, 0, 7, 5.0)


def test_absurd_sequence_numbers_do_not_break_the_report() -> None:
    recorder = Recorder("cstr", 0)
    for key in ("reactor/cstr/sample/T", "reactor/cstr/sample/C"):
        for sequence in (0, 2**64 - 1):
            recorder.on_message(encoded(messages.Sample(sequence=sequence, time_ns=sequence % 7, quality=GOOD), key), 0)
    assert health(recorder).lost == 2**64 - 1


def test_health_goes_out_under_the_plant_with_the_longest_lag_since_the_last() -> None:
    recorder = Recorder("site", 2_000_000_000)
    recorder.on_message(encoded(messages.Sample(quality=GOOD), received_ns=3_000_000_000), 3_007_000_000)
    recorder.on_message(encoded(messages.Sample(quality=GOOD), received_ns=3_008_000_000), 3_009_000_000)
    first = recorder.health(5_000_000_000)
    assert first.key == keys.key("site", keys.HEALTH, "recorder")
    assert isinstance(first.message, messages.Health)
    assert (first.message.uptime_s, first.message.lag_ms, first.message.phase) == (3.0, 7.0, "recording")
    second = health(recorder)
    assert (second.lag_ms, second.published) == (0.0, 2)


def test_the_time_of_what_the_recorder_adds_is_not_before_any_message() -> None:
    recorder = Recorder("cstr", 100)
    assert [recorder.monotonic_ns(at) for at in (50, 300, 200)] == [100, 300, 300]
    kept = recorder.on_message(encoded(messages.Sample(quality=GOOD), received_ns=250), 400)
    assert kept is not None
    assert kept.log_time_ns == 300


def test_a_message_of_an_earlier_file_is_left_out_once_and_only_until_the_history_has_come() -> None:
    message = encoded(messages.Sample(sequence=1, time_ns=1, quality=GOOD))
    known = {fingerprint(message.key, message.payload)}
    recorder = Recorder("cstr", 0, known, fingerprints_until_ns=10)
    assert [recorder.on_message(message, 10) is None for _ in range(2)] == [True, False]
    assert Recorder("cstr", 0, known, fingerprints_until_ns=10).on_message(message, 11) is not None
    assert health(recorder).received == 2


@pytest.mark.parametrize(
    "message",
    [
        encoded(messages.Sample(sequence=5, time_ns=5)),  # no quality: it is no sample
        encoded(messages.Sample(sequence=5, time_ns=-1, quality=GOOD)),
        encoded(messages.Estimate(time_ns=5), "reactor/cstr/estimate/T"),
        encoded(messages.Sample(sequence=5, time_ns=5, quality=GOOD), "plant/sample/T"),
    ],
)
def test_what_is_no_sample_is_not_counted_as_one_whether_an_earlier_file_holds_it_or_not(message: Encoded) -> None:
    first = messages.Sample(time_ns=0, sequence=0, quality=GOOD)
    for known in ({fingerprint(message.key, message.payload)}, set[int]()):
        recorder = Recorder("cstr", 0, known, fingerprints_until_ns=10)
        recorder.on_message(encoded(first, message.key), 1)
        assert (recorder.on_message(message, 1) is None) is bool(known)
        report = health(recorder)
        assert (report.lost, report.duplicated, report.out_of_order) == (0, 0, 0)
        assert not known or set(report.refused_by_reason) <= {"key"}  # that of the first message


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="the memory of a process is read from /proc")
@pytest.mark.parametrize(("unit_bytes", "count"), [(1_000_000, 150), (200, 200_000)])
def test_samples_leave_no_memory_behind(unit_bytes: int, count: int) -> None:
    recorder, message = Recorder("cstr", 0), encoded(messages.Sample(time_ns=1, quality=GOOD, unit="g" * unit_bytes))
    recorder.on_message(message, 1)
    before = resident_bytes()
    for _ in range(count):
        recorder.on_message(message, 1)
    assert resident_bytes() - before < 10_000_000


@pytest.mark.parametrize(
    ("stream", "lost"),
    [("reactor/cstr/sample", 0), ("reactor/cstr/alarm", 3), ("reactor/cstr", 3), ("elsewhere", 3)],
)
def test_messages_lost_on_the_bus_are_counted_but_samples_which_are_counted_by_their_numbers(
    stream: str, lost: int
) -> None:
    recorder = Recorder("cstr", 0)
    for _ in range(2):
        recorder.on_gap(Gap(stream, 7, 8, 10, 3, 0))
    assert health(recorder).lost == 2 * lost


def test_a_key_without_room_raises_one_alarm_which_clears_a_minute_after_the_last_such_message() -> None:
    recorder, minute_ns = Recorder("cstr", 0), 60_000_000_000
    ours, theirs = (recorder.on_message(encoded(messages.Sample(quality=GOOD), key), 0) for key in (KEY, "x" * 300))
    assert ours is not None
    assert theirs is not None
    alarm, report = (item.message for item in recorder.reject_key(theirs, 5))
    assert isinstance(alarm, messages.Alarm)
    assert isinstance(report, messages.Health)
    assert alarm.text == (
        f"not everything is recorded: a file has no room for more keys of other programs, {'x' * 200!r} for instance"
    )
    assert (alarm.alarm, alarm.event, alarm.raised_ns) == (KEYS_ALARM, "raised", 5)
    assert report.refused_by_reason["too many keys"] == 1
    assert recorder.clear_keys_alarm(5 + minute_ns - 1) == []
    assert recorder.reject_key(ours, minute_ns) == []
    assert recorder.clear_keys_alarm(2 * minute_ns - 1) == []
    (cleared,) = [item.message for item in recorder.clear_keys_alarm(2 * minute_ns)]
    assert isinstance(cleared, messages.Alarm)
    assert cleared.text == "everything is recorded again; 2 messages are missing so far"
    assert recorder.clear_keys_alarm(4 * minute_ns) == []
    again = recorder.reject_key(ours, 5 * minute_ns)[0].message
    assert isinstance(again, messages.Alarm)
    assert f"no room for more keys of this software, {KEY!r} for instance" in again.text


def test_keys_without_room_are_logged_once_a_minute(capsys: pytest.CaptureFixture[str]) -> None:
    recorder, minute_ns = Recorder("cstr", 0), 60_000_000_000
    received = recorder.on_message(encoded(messages.Sample(quality=GOOD)), 0)
    assert received is not None
    lines = []
    for now_ns in (0, 1, minute_ns - 1, minute_ns, minute_ns + 1):
        recorder.reject_key(received, now_ns)
        lines.append(capsys.readouterr().out.count("not recorded: too many keys"))
    assert lines == [1, 0, 0, 1, 0]


def test_a_recorder_that_stops_raises_one_alarm_until_it_resumes_and_counts_what_is_missing() -> None:
    recorder = Recorder("cstr", 0)
    alarm, report = (item.message for item in recorder.stop_recording("no space left", 5))
    assert isinstance(alarm, messages.Alarm)
    assert isinstance(report, messages.Health)
    assert alarm.text == "recording stopped: no space left; it resumes when a file can be written"
    assert (alarm.alarm, alarm.priority, report.phase) == (DISK_ALARM, messages.PRIORITY_CRITICAL, "not recording")
    assert recorder.is_stopped
    (report,) = (item.message for item in recorder.stop_recording("no space left", 6))
    assert isinstance(report, messages.Health)
    recorder.count_unrecorded(2)
    recorder.count_unrecorded(3)
    cleared, report = (item.message for item in recorder.resume_recording(7))
    assert isinstance(cleared, messages.Alarm)
    assert isinstance(report, messages.Health)
    assert cleared.text == "recording resumed; 5 messages are missing so far"
    assert (report.phase, report.refused_by_reason["disk"], recorder.is_stopped) == ("recording", 5, False)
    last = recorder.health(8, "stopped").message
    assert isinstance(last, messages.Health)
    assert last.phase == "stopped"


def test_out_of_order_samples_of_evicted_keys_stay_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The least recently used key is the one that is evicted."""
    monkeypatch.setattr("recorder.core.MAX_COUNTERS", 2)
    recorder = Recorder("cstr", 0)

    def receive(plant: str, *sequences: int) -> None:
        for sequence in sequences:
            sample = messages.Sample(sequence=sequence, time_ns=sequence, quality=GOOD)
            recorder.on_message(encoded(sample, f"reactor/{plant}/sample/T"), 0)

    receive("a", 0, 2, 1)
    receive("b", 0, 2, 1)
    receive("a", 3)
    receive("c", 0)
    assert health(recorder).out_of_order == 2
    receive("a", 5)
    assert health(recorder).lost == 1, "a is still followed"
    receive("b", 9)
    assert health(recorder).lost == 1, "b starts again"


@pytest.mark.parametrize("unreadable", [True, False])
def test_the_channel_of_a_message_is_of_the_product_if_key_and_payload_are(*, unreadable: bool) -> None:
    for key, is_ours in ((KEY, True), ("plant/T", False)):
        message = encoded(messages.Sample(quality=GOOD), key)
        kept = Recorder("cstr", 0).on_message(message._replace(payload=b"\xff") if unreadable else message, 0)
        assert kept is not None
        channel = kept.channel
        assert (channel.key, channel.encoding) == (key, message.encoding)
        assert (channel.is_product, channel.is_readable) == (is_ours and not unreadable, not unreadable)


@pytest.mark.parametrize(
    ("message", "publish_time_ns", "sequence", "refused"),
    [
        (encoded(messages.Estimate(time_ns=5), "reactor/cstr/estimate/T"), 5, 0, {}),
        (encoded(messages.Estimate(time_ns=-5), "reactor/cstr/estimate/T"), 9, 0, {"time": 1}),
        (encoded(messages.Sample(time_ns=5, sequence=3, quality=GOOD), "plant/T"), 5, 3, {"key": 1}),
        (encoded(messages.Sample(time_ns=0, sequence=3), "plant/T"), 0, 3, {"key": 1, "payload": 1}),
        (encoded(messages.Sample(time_ns=-5, sequence=3), "plant/T"), 9, 3, {"key": 1, "time": 1}),
        (encoded(messages.Sample(time_ns=-5, sequence=3)), 9, 3, {"time": 1}),
        (encoded(messages.Sample(time_ns=5, sequence=3))._replace(payload=b"\xff"), 9, 0, {"payload": 1}),
        (Encoded(KEY, b"{}", "application/json"), 9, 0, {"encoding": 1}),
    ],
)
def test_a_message_has_its_own_time_and_number_where_they_can_be_read(
    message: Encoded, publish_time_ns: int, sequence: int, refused: dict[str, int]
) -> None:
    recorder = Recorder("cstr", 0)
    kept = recorder.on_message(message, 9)
    assert kept is not None
    assert (kept.log_time_ns, kept.publish_time_ns, kept.sequence) == (9, publish_time_ns, sequence)
    assert health(recorder).refused_by_reason == refused


def test_a_sample_that_is_too_large_is_recorded_as_one_that_cannot_be_read(monkeypatch: pytest.MonkeyPatch) -> None:
    message = encoded(messages.Sample(time_ns=5, sequence=3, quality=GOOD))
    for room, sequence in ((len(message.payload), 3), (len(message.payload) - 1, 0)):
        monkeypatch.setattr("recorder.core.MAX_PAYLOAD", room)
        monkeypatch.setattr("reactorwatch.contract.codec.MAX_PAYLOAD", room)
        kept = Recorder("cstr", 0).on_message(message, 9)
        assert kept is not None
        assert (kept.sequence, kept.channel.is_readable) == (sequence, sequence == 3)
