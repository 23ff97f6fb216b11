"""Keys of other programs take no room from keys of the product, and what is not recorded raises an alarm."""

from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Encoded, Publication, encode
from recorder import Channel, RecordedMessage, keep
from recorder.core import KEYS_ALARM
from recorder.files.recording import Recording
from recorder.files.writer import RecordingWriter, WriteError
from recorder.keep import MAX_OTHER_CHANNELS, ChannelBudget
from tests.unit.recorder import golden
from tests.unit.recorder.recording import SECOND, Fed, recorder

GOOD = messages.QUALITY_GOOD
START = golden.RECEIVED_NS
SAMPLE = encode(Publication("", messages.Sample(quality=GOOD)))

STRAYS: dict[str, Callable[[int], Encoded]] = {
    "no payload": lambda number: Encoded(f"reactor/x/sample/{number}", b"", "?"),
    "another payload": lambda number: Encoded(f"reactor/x/sample/{number}", b"\xff\xff", SAMPLE.encoding),
    "another encoding each": lambda number: Encoded("reactor/cstr/sample/T", b"{}", f"text/{number}"),
    "our messages on keys of others": lambda number: SAMPLE._replace(key=f"weather/{number}"),
}


def sample(plant: str, sequence: int = 0) -> Encoded:
    return encode(Publication(f"reactor/{plant}/sample/T", messages.Sample(sequence=sequence, quality=GOOD)))


def receive(fed: Fed, received: Iterable[Encoded], apart_ns: int = 0) -> None:
    for message in received:
        fed.pass_time(apart_ns)
        fed.published += fed.node.on_message(message._replace(received_ns=fed.now_ns), fed.now_ns)


def recorded_keys(folder: Path) -> set[str]:
    return {entry.key for entry in Recording(folder).messages()}


@pytest.mark.parametrize("kind", STRAYS)
def test_10_000_stray_keys_take_no_room_from_messages_of_the_product(tmp_path: Path, kind: str) -> None:
    fed = recorder(tmp_path, START, most_keys=200, black_box_min=0.0)
    receive(fed, map(STRAYS[kind], range(10_000)))
    receive(fed, (sample(f"p{number}") for number in range(100)))
    (raised,) = fed.alarms()
    assert (raised.alarm, raised.event) == (KEYS_ALARM, "raised")
    assert "for more keys of other programs" in raised.text
    fed.pass_time(120 * SECOND)
    assert fed.alarms()[-1].event == "cleared"
    fed.stop()
    assert {f"reactor/p{number}/sample/T" for number in range(100)} <= recorded_keys(tmp_path)
    assert fed.last_health().refused_by_reason["too many keys"] == 10_000 - MAX_OTHER_CHANNELS


def test_messages_of_the_product_beyond_the_budget_raise_the_alarm_and_those_within_it_continue(tmp_path: Path) -> None:
    fed = recorder(tmp_path, START, most_keys=100, black_box_min=0.0)
    for second in range(100):
        receive(fed, (sample(f"p{number}", second) for number in range(105)))
        fed.pass_time(SECOND)
    (raised,) = fed.alarms()
    receive(fed, [encode(Publication(f"reactor/cstr/alarm/{KEYS_ALARM}", raised))])
    assert "for more keys of this software" in raised.text
    assert "'reactor/p100/sample/T'" in raised.text
    fed.stop()
    files = Recording(tmp_path).files
    assert len(files) == 1  # every key is in use: another file would have no room for more
    samples = {f"reactor/p{number}/sample/T" for number in range(100)}
    own = {f"reactor/cstr/alarm/{KEYS_ALARM}", "reactor/cstr/health/recorder"}
    assert recorded_keys(tmp_path) == samples | own
    assert fed.last_health().refused_by_reason["too many keys"] == 5 * 100


def test_silent_keys_give_their_budget_to_others_in_the_next_file(tmp_path: Path) -> None:
    """Forged messages of the product on 100 keys are forgotten; the keys of a sound plant have room again."""
    fed = recorder(tmp_path, START, most_keys=100, black_box_min=0.0)
    receive(fed, (sample(f"forged{number}") for number in range(150)))
    for second in range(100):
        receive(fed, [sample("cstr", second)])
        fed.pass_time(SECOND)
    fed.pass_time(SECOND)
    assert [item.event for item in fed.alarms()] == ["raised"]
    receive(fed, (sample("cstr", second) for second in range(100, 200)), SECOND)
    assert [item.event for item in fed.alarms()] == ["raised", "cleared"]
    fed.stop()
    first, second_file = Recording(tmp_path).files
    assert recorded_keys(second_file) == {"reactor/cstr/sample/T", "reactor/cstr/health/recorder"}
    assert "reactor/cstr/sample/T" not in recorded_keys(first)


def test_a_fleet_of_12_000_plants_has_room_for_five_keys_each() -> None:
    room = ChannelBudget(keep.MAX_KEYS)
    assert all(
        room.admit(Channel(f"reactor/p{plant}/sample/{key}", SAMPLE.encoding, is_product=True), 0)
        for plant in range(12_000)
        for key in range(5)
    )


def test_room_is_bounded_by_what_the_format_can_number() -> None:
    assert keep.MAX_KEYS + MAX_OTHER_CHANNELS < keep.MAX_CHANNELS


def test_reserved_keys_have_room_in_a_full_file() -> None:
    own = keys.key("cstr", keys.ALARM, KEYS_ALARM)
    room = ChannelBudget(100, reserved=(own,))
    admitted = [room.admit(Channel(f"reactor/{n}/sample/T", "", is_product=True), 0) for n in range(101)]
    assert admitted == [True] * 100 + [False]
    assert room.admit(Channel(own, "", is_product=True), 0)


def test_messages_repeated_at_the_start_of_a_file_count_too() -> None:
    room = ChannelBudget(100)
    room.reset(latched=50)
    assert sum(room.admit(Channel(f"reactor/{n}/sample/T", "", is_product=True), 0) for n in range(100)) == 50


def test_a_new_file_has_channels_for_other_programs_again() -> None:
    room = ChannelBudget(100)
    others = [Channel(f"weather/{n}", "", is_product=False) for n in range(MAX_OTHER_CHANNELS + 1)]
    assert [room.admit(item, 0) for item in others] == [True] * MAX_OTHER_CHANNELS + [False]
    room.reset(latched=0)
    assert not room.has(others[0])
    assert room.admit(others[-1], 0)


@pytest.mark.parametrize(("inactive", "is_needed"), [(9, False), (10, True)])
def test_a_full_file_is_followed_by_another_if_a_tenth_of_its_keys_is_inactive(inactive: int, is_needed: bool) -> None:
    room = ChannelBudget(100)
    own = [Channel(f"reactor/{n}/sample/T", "", is_product=True) for n in range(101)]
    for n in range(100):
        room.admit(own[n], 0 if n < inactive else 1)
    others = (own[0], Channel("weather/1", "", is_product=False))
    assert not any(room.needs_new_file(item, keep.INACTIVE_NS) for item in others)
    assert room.needs_new_file(own[100], keep.INACTIVE_NS) == is_needed
    assert not room.needs_new_file(own[100], keep.INACTIVE_NS + keep.CHECK_INTERVAL_NS)  # asked once an interval


def test_latched_messages_take_at_most_half_of_the_keys_of_a_file() -> None:
    assert ChannelBudget(100).max_latched_messages == 50


def test_a_channel_beyond_those_that_the_format_can_number_is_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("recorder.files.writer.MAX_CHANNELS", 3)
    first = RecordedMessage("", b"", "?", 0, 0)
    with RecordingWriter(tmp_path / "run.mcap", {}) as writer:
        for number in range(3):
            writer.write(first._replace(key=f"reactor/p{number}/sample/T"))
        with pytest.raises(WriteError, match="a file has room for 3 keys, and 'reactor/p3/sample/T' is one more"):
            writer.write(first._replace(key="reactor/p3/sample/T"))
