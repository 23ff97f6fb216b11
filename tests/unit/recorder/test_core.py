"""Messages as the recorder stores them."""

import pytest

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Body, Encoded, Publication, encode, encode_message, encoding_of
from recorder import RecordedMessage
from recorder.core import Recorder, fingerprint

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
