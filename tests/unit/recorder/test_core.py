"""Messages as the recorder stores them, and its own alarms."""

import os
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Body, Encoded, Publication, encode, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, AlarmCommand, CommandReply, ListAlarms
from reactorwatch.runtime.reorder_buffer import Gap
from recorder.core import DISK_ALARM, KEYS_ALARM, PRIORITIES, OwnAlarms, ReceivedMessage, Recorder, fingerprint
from tests.unit.recorder.recording import MINUTE

KEY = "reactor/cstr/sample/T"
GOOD = messages.QUALITY_GOOD


def encoded(message: Body, key: str = KEY, received_ns: int = 0) -> Encoded:
    return encode(Publication(key, message))._replace(received_ns=received_ns)


def sample(number: int, key: str = KEY, received_ns: int = 0) -> Encoded:
    return encoded(messages.Sample(sequence=number, time_ns=number % 2**63, quality=GOOD), key, received_ns)


def receive(recorder: Recorder, message: Encoded, now_ns: int = 0) -> ReceivedMessage:
    """A message that is to be recorded."""
    found = recorder.on_message(message, now_ns)
    assert found is not None
    return found


def health(recorder: Recorder, now_ns: int = 1000) -> messages.Health:
    (report,) = contents([recorder.health(now_ns)])
    assert isinstance(report, messages.Health)
    return report


def contents(published: list[Publication]) -> list[Any]:
    return [item.message for item in published]


def test_the_time_of_receipt_never_runs_backwards() -> None:
    recorder = Recorder("cstr", 100)
    assert [receive(recorder, sample(0, received_ns=at), 500).log_time_ns for at in (300, 200, 400)] == [300, 300, 400]


def test_the_time_of_what_the_recorder_adds_is_not_before_any_message() -> None:
    recorder = Recorder("cstr", 100)
    assert [recorder.monotonic_ns(at) for at in (50, 300, 200)] == [100, 300, 300]
    assert receive(recorder, sample(0, received_ns=250), 400).log_time_ns == 300


@pytest.mark.parametrize(
    ("message", "publish_time_ns", "sequence", "refused"),
    [
        (encoded(messages.Sample(time_ns=77, sequence=1, quality=GOOD)), 77, 1, {}),
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
def test_any_message_is_kept_with_its_own_time_and_number_where_they_can_be_read_and_refusals_are_counted(
    message: Encoded, publish_time_ns: int, sequence: int, refused: dict[str, int]
) -> None:
    recorder = Recorder("cstr", 0)
    kept = receive(recorder, message, 9)
    assert (kept.log_time_ns, kept.publish_time_ns, kept.sequence) == (9, publish_time_ns, sequence)
    assert kept.recorded_message[:3] == message[:3]
    assert kept.channel.is_readable == (message.payload not in (b"\xff", b"{}"))
    assert kept.channel.is_product == (kept.channel.is_readable and message.key.startswith("reactor/"))
    assert health(recorder).refused_by_reason == refused


def test_a_sample_that_is_too_large_is_recorded_as_one_that_cannot_be_read(monkeypatch: pytest.MonkeyPatch) -> None:
    message = sample(3)
    for room, sequence in ((len(message.payload), 3), (len(message.payload) - 1, 0)):
        monkeypatch.setattr("recorder.core.MAX_PAYLOAD", room)
        monkeypatch.setattr("reactorwatch.contract.codec.MAX_PAYLOAD", room)
        kept = receive(Recorder("cstr", 0), message)
        assert (kept.sequence, kept.channel.is_readable) == (sequence, sequence == 3)


def test_health_reports_losses_by_key_and_absurd_numbers_do_not_break_it() -> None:
    recorder = Recorder("cstr", 0)
    for key, sequences in ((KEY, (0, 1, 5)), ("reactor/cstr/sample/C", (0, 1, 1, 3, 2))):
        for number in sequences:
            recorder.on_message(sample(number, key), 0)
    report = health(recorder)
    assert (report.lost, report.duplicated, report.out_of_order, report.received) == (3, 1, 1, 8)
    for key in (KEY, "reactor/cstr/sample/C"):
        recorder.on_message(encoded(messages.Sample(sequence=2**64 - 1, time_ns=99, quality=GOOD), key), 0)
    assert health(recorder).lost == 2**64 - 1


def test_counts_of_evicted_keys_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    """The least recently used key is the one that is evicted."""
    monkeypatch.setattr("recorder.core.MAX_KEYS", 2)
    recorder = Recorder("cstr", 0)

    def counts(plant: str, *sequences: int) -> tuple[int, int, int]:
        for number in sequences:
            recorder.on_message(sample(number, f"reactor/{plant}/sample/T"), 0)
        report = health(recorder)
        return report.lost, report.out_of_order, report.duplicated

    counts("a", 0, 2, 1)
    counts("b", 0, 2, 1, 1)
    counts("a", 3)
    assert counts("c", 0) == (0, 2, 1)
    assert counts("a", 5) == (1, 2, 1), "a is still followed"
    assert counts("b", 9) == (1, 2, 1), "b starts again"


def test_health_has_the_longest_lag_since_the_last_report() -> None:
    recorder = Recorder("site", 2_000_000_000)
    recorder.on_message(sample(0, received_ns=3_000_000_000), 3_007_000_000)
    recorder.on_message(sample(1, received_ns=3_008_000_000), 3_009_000_000)
    assert recorder.health(5_000_000_000).key == keys.key("site", keys.HEALTH, "recorder")
    recorder.on_message(sample(2, received_ns=5_000_000_000), 5_001_000_000)
    report = health(recorder, 6_000_000_000)
    assert (report.uptime_s, report.lag_ms, report.phase, report.published) == (4.0, 1.0, "recording", 2)


def test_samples_of_an_earlier_file_are_not_lost_and_their_lag_is_reported() -> None:
    """The recorder before had a gap of two; the history of this one holds them, and what was recorded before it."""
    history = [sample(number, received_ns=1) for number in range(7)]
    recorded = {fingerprint(item.key, item.payload) for number, item in enumerate(history) if number not in (2, 3, 6)}
    recorder = Recorder("cstr", 0, recorded, fingerprints_until_ns=10_000_000)
    found = [recorder.on_message(item, 5_000_001) for item in history]
    assert [item.sequence for item in found if item is not None] == [2, 3, 6]
    report = health(recorder)
    assert (report.lost, report.out_of_order, report.received, report.lag_ms) == (0, 0, 7, 5.0)


def test_a_message_of_an_earlier_file_is_left_out_once_and_only_until_the_history_has_come() -> None:
    message = sample(1)
    known = {fingerprint(message.key, message.payload)}
    recorder = Recorder("cstr", 0, known, fingerprints_until_ns=10)
    assert [recorder.on_message(message, 10) is None for _ in range(2)] == [True, False]
    assert Recorder("cstr", 0, known, fingerprints_until_ns=10).on_message(message, 11) is not None


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
    for known in ({fingerprint(message.key, message.payload)}, set[int]()):
        recorder = Recorder("cstr", 0, known, fingerprints_until_ns=10)
        recorder.on_message(sample(0, message.key), 1)
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
    recorder = Recorder("cstr", 0)
    own, other = (receive(recorder, sample(0, key)) for key in (KEY, "x" * 300))
    alarm, report = contents(recorder.reject_key(other, 5))
    assert alarm.text == (
        f"not everything is recorded: a file has no room for more keys of other programs, {'x' * 200!r} for instance"
    )
    assert (alarm.alarm, alarm.event, alarm.raised_ns) == (KEYS_ALARM, "raised", 5)
    assert report.refused_by_reason["too many keys"] == 1
    assert recorder.clear_keys_alarm(5 + MINUTE - 1) == []
    assert recorder.reject_key(own, MINUTE) == []
    assert recorder.clear_keys_alarm(2 * MINUTE - 1) == []
    (cleared,) = contents(recorder.clear_keys_alarm(2 * MINUTE))
    assert cleared.text == "everything is recorded again; 2 messages are missing so far"
    assert recorder.clear_keys_alarm(4 * MINUTE) == []
    again, _ = contents(recorder.reject_key(own, 5 * MINUTE))
    assert f"no room for more keys of this software, {KEY!r} for instance" in again.text


def test_keys_without_room_are_logged_once_a_minute(capsys: pytest.CaptureFixture[str]) -> None:
    recorder, lines = Recorder("cstr", 0), []
    received = receive(recorder, sample(0))
    for now_ns in (0, 1, MINUTE - 1, MINUTE, MINUTE + 1):
        recorder.reject_key(received, now_ns)
        lines.append(capsys.readouterr().out.count("not recorded: too many keys"))
    assert lines == [1, 0, 0, 1, 0]


def test_a_recorder_that_stops_raises_one_alarm_until_it_resumes_and_counts_what_is_missing() -> None:
    recorder = Recorder("cstr", 0)
    alarm, report = contents(recorder.stop_recording("no space left", 5))
    assert alarm.text == "recording stopped: no space left; it resumes when a file can be written"
    assert (alarm.alarm, alarm.priority, report.phase) == (DISK_ALARM, messages.PRIORITY_CRITICAL, "not recording")
    assert len(recorder.stop_recording("no space left", 6)) == 1, "its health alone"
    recorder.count_unrecorded(2)
    recorder.count_unrecorded(3)
    cleared, report = contents(recorder.resume_recording(7))
    assert cleared.text == "recording resumed; 5 messages are missing so far"
    assert (report.phase, report.refused_by_reason["disk"], recorder.is_stopped) == ("recording", 5, False)


NORMAL, RAISED = messages.ALARM_STATE_NORMAL, messages.ALARM_STATE_UNACKNOWLEDGED
SEEN, GONE = messages.ALARM_STATE_ACKNOWLEDGED, messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED
EACH = pytest.mark.parametrize("name", list(PRIORITIES))


def ask(alarms: OwnAlarms, command: str, message: Message) -> tuple[CommandReply, list[Publication]]:
    return alarms.execute(Encoded(keys.key("cstr", keys.COMMAND, command), *encode_message(message)), 7)


def acknowledge(alarms: OwnAlarms, name: str) -> tuple[CommandReply, list[Publication]]:
    return ask(alarms, keys.ACKNOWLEDGE_RECORDER, AlarmCommand(alarm=name, by="Ada", comment="I make room"))


def now(alarms: OwnAlarms, name: str) -> Alarm:
    listed = ask(alarms, keys.LIST_RECORDER_ALARMS, ListAlarms())[0].alarms
    return next(alarm for alarm in listed if alarm.alarm == name)


@EACH
def test_each_goes_through_the_states_that_any_alarm_does_and_the_others_stay_as_they_are(name: str) -> None:
    """ISA-18.2: raised, acknowledged, cleared; and raised, cleared, acknowledged."""
    alarms, states = OwnAlarms("cstr"), []

    def note() -> None:
        alarm = now(alarms, name)
        states.append((alarm.state, alarm.raised_ns, alarm.cleared_ns, alarm.by))

    for at in (1, 3):
        alarms.raise_alarm(name, "no space left", at)
        note()
        if at == 1:
            acknowledge(alarms, name)
            note()
        alarms.clear(name, "there is room", at + 1)
        note()
    acknowledge(alarms, name)
    note()
    assert states == [
        (RAISED, 1, 0, ""), (SEEN, 1, 0, "Ada"), (NORMAL, 1, 2, "Ada"),
        (RAISED, 3, 0, ""), (GONE, 3, 4, ""), (NORMAL, 3, 4, "Ada"),
    ]  # fmt: skip
    assert {now(alarms, other).state for other in PRIORITIES if other != name} == {NORMAL}
    assert now(alarms, name).priority == PRIORITIES[name]


@EACH
def test_each_is_acknowledged_once_after_it_is_raised_and_published_with_person_and_comment(name: str) -> None:
    alarms = OwnAlarms("cstr")
    assert "is normal, there is nothing to acknowledge" in acknowledge(alarms, name)[0].text
    alarms.raise_alarm(name, "no space left", 1)
    reply, (published,) = acknowledge(alarms, name)
    assert (reply.accepted, published.key) == (True, f"reactor/cstr/alarm/{name}")
    message: Any = published.message
    assert reply.alarms[0] == message == now(alarms, name)
    assert (message.event, message.by, message.comment, message.time_ns) == ("acknowledge", "Ada", "I make room", 7)
    assert "is acknowledged already" in acknowledge(alarms, name)[0].text


@pytest.mark.parametrize(
    ("command", "message", "text"),
    [
        (keys.ACKNOWLEDGE_RECORDER, AlarmCommand(alarm=DISK_ALARM), "by must name the person"),
        (keys.ACKNOWLEDGE_RECORDER, AlarmCommand(alarm="ewma/T", by="Ada"), "no alarm 'ewma/T' of the recorder"),
        (keys.ACKNOWLEDGE_RECORDER, AlarmCommand(alarm=DISK_ALARM, by="A", comment="x" * 1001), "at most 1000"),
        (keys.ACKNOWLEDGE_RECORDER, ListAlarms(), "command acknowledge_recorder must carry"),
        ("shelve", AlarmCommand(), "unknown command 'shelve' (valid: list_recorder_alarms, acknowledge_recorder)"),
    ],
)
def test_what_cannot_be_done_is_refused_with_the_reason(command: str, message: Message, text: str) -> None:
    alarms = OwnAlarms("cstr")
    alarms.raise_alarm(DISK_ALARM, "no space left", 1)
    reply, published = ask(alarms, command, message)
    assert (reply.accepted, published) == (False, [])
    assert text in reply.text
    assert now(alarms, DISK_ALARM).state == RAISED
