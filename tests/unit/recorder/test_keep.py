"""Rules for the files of a recorder: names, flushes, rotation, deletion, black box, room for keys, latched messages."""

import itertools
from math import inf
from pathlib import Path

import pytest
from google.protobuf.message import Message
from hypothesis import given
from hypothesis import strategies as st

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.records.record import MINUTE_NS
from recorder import Channel, RecordedMessage
from recorder.core import KEYS_ALARM
from recorder.keep import (
    MAX_CHANNELS,
    MAX_KEYS,
    MAX_MARGINS,
    MAX_OTHER_CHANNELS,
    SECOND_NS,
    AlarmInterval,
    BlackBox,
    ChannelBudget,
    CompleteRecording,
    FileNames,
    FlushAndRotation,
    Fsync,
    LatchedMessages,
    Limits,
    select_deletions,
)

NOON_NS = 1_782_907_205 * 10**9
"""2026-07-01T12:00:05Z"""


@pytest.mark.parametrize(
    ("out", "existing", "expected"),
    [
        ("out", [], "R-20260701T120005Z.mcap"),
        ("out", ["R-20260701T120005Z.mcap", "R-20260701T120005Z-2.mcap", "R-20260701T120004Z-7.mcap"], "-3.mcap"),
        ("run.mcap", [], "run.mcap"),
        ("run.mcap", ["run.mcap"], "run-2.mcap"),
        ("run.mcap", ["run-9.mcap", "run-10.mcap", "mine.mcap"], "run-11.mcap"),  # no name of a deleted one
    ],
)
def test_files_have_the_plant_s_name_and_start_or_are_numbered(out: str, existing: list[str], expected: str) -> None:
    assert FileNames.of(Path(out), "R", is_folder=False).next(NOON_NS, existing).name.endswith(expected)


def test_a_folder_whose_name_ends_like_a_recording_is_a_folder() -> None:
    assert FileNames.of(Path("run.mcap"), "R", is_folder=True).folder == Path("run.mcap")


@pytest.mark.parametrize(
    ("out", "name", "own"),
    [
        ("out", "cstr-20260701T120005Z.mcap", True),
        ("out", "cstr-20260701T120005Z-12.mcap", True),
        ("out", "cstr-2-20260701T120005Z.mcap", False),
        ("out", "cstr-20260701T120005Z-recovered.mcap", False),
        ("out", "cstr.mcap", False),
        ("run.mcap", "run.mcap", True),
        ("run.mcap", "run-2.mcap", True),
        ("run.mcap", "run-two.mcap", False),
        ("run.mcap", "rerun.mcap", False),
        ("run.mcap", "run.mcap.part", False),
        ("r.n.mcap", "run.mcap", False),
    ],
)
def test_no_foreign_file_is_taken_for_its_own(out: str, name: str, own: bool) -> None:
    assert FileNames.of(Path(out), "cstr", is_folder=False).owns(name) is own


HALF = SECOND_NS // 2
START = 1_000 * SECOND_NS


def filing(fsync: Fsync = "never", rotate_s: float = inf, rotate_bytes: float = inf) -> FlushAndRotation:
    return FlushAndRotation(HALF, fsync, rotate_s * SECOND_NS, rotate_bytes, START)


@given(gaps=st.lists(st.integers(0, 2 * SECOND_NS), max_size=60))
def test_no_message_waits_longer_than_the_period_for_its_flush(gaps: list[int]) -> None:
    """Driven as the loop drives it: at each message, and at the moment that was named as the next."""
    decide, now = filing(), START
    waiting: list[int] = []

    def look(now: int) -> None:
        if decide.flush_is_due(now):
            assert all(now - since <= HALF for since in waiting)
            waiting.clear()
            decide.mark_flushed()

    for gap in gaps:
        while (due := decide.next_due_ns()) <= now + gap:
            look(due)
        now += gap
        decide.count_message(now)
        waiting.append(now)
        look(now)
    assert all(now - since < HALF for since in waiting)
    assert decide.unflushed == len(waiting)


def test_without_messages_nothing_is_due() -> None:
    decide = filing("second", rotate_s=1)
    assert not decide.flush_is_due(START + 100 * SECOND_NS)
    assert not decide.is_full(START + 100 * SECOND_NS, 10**9)
    assert decide.next_due_ns() > START + 10**6 * SECOND_NS


@pytest.mark.parametrize(("fsync", "synced"), [("never", 0), ("chunk", 20), ("second", 10)])
def test_the_policy_sets_how_often_ten_seconds_are_synced(fsync: Fsync, synced: int) -> None:
    """A message each tenth of a second, a flush each half, from START on."""
    decide, syncs = filing(fsync), 0
    for tenth in range(101):
        now = START + tenth * SECOND_NS // 10
        if decide.flush_is_due(now):
            decide.mark_flushed()
        if decide.sync_is_due(now):
            syncs += 1
            decide.mark_synced(now)
        if tenth % 5 == 0:
            decide.count_message(now)
    assert syncs == synced


def test_a_file_is_full_by_age_or_by_size() -> None:
    decide = filing(rotate_s=60, rotate_bytes=1000)
    decide.count_message(START)
    assert not decide.is_full(START + 59 * SECOND_NS, 999)
    assert decide.is_full(START + 59 * SECOND_NS, 1000)
    assert decide.is_full(START + 60 * SECOND_NS, 0)
    decide.start_file(START + 60 * SECOND_NS)
    decide.count_message(START + 60 * SECOND_NS)
    assert not decide.is_full(START + 119 * SECOND_NS, 0)


def test_a_clock_that_is_set_back_puts_nothing_off() -> None:
    decide = filing(rotate_s=60)
    decide.count_message(START)
    hour_ago = START - 3600 * SECOND_NS
    assert not decide.flush_is_due(hour_ago)
    assert decide.flush_is_due(hour_ago + HALF)
    assert decide.is_full(hour_ago + 60 * SECOND_NS, 0)


def test_a_sync_is_due_a_second_after_the_last_one_when_the_clock_is_set_back_before_it() -> None:
    decide = filing("second")
    decide.count_message(START)
    decide.mark_flushed()
    hour_ago = START - 3600 * SECOND_NS
    assert not decide.sync_is_due(hour_ago)
    assert decide.next_due_ns() == hour_ago + SECOND_NS
    assert decide.sync_is_due(hour_ago + SECOND_NS)


FILES = [CompleteRecording(Path(f"{name}.mcap"), 100, at) for name, at in (("c", 30), ("a", 10), ("b", 20))]


@pytest.mark.parametrize(
    ("limits", "gone"),
    [
        (Limits(), []),
        (Limits(files=4), []),
        (Limits(files=3), ["a"]),
        (Limits(files=1), ["a", "b", "c"]),
        (Limits(size_bytes=350), []),
        (Limits(size_bytes=349), ["a"]),
        (Limits(size_bytes=10), ["a", "b", "c"]),
        (Limits(age_ns=30), []),
        (Limits(age_ns=25), ["a"]),
        (Limits(age_ns=15, files=3), ["a", "b"]),
    ],
)
def test_the_oldest_go_until_the_rest_and_the_file_being_written_are_within_limits(
    limits: Limits, gone: list[str]
) -> None:
    assert [path.stem for path in select_deletions(FILES, 50, limits, now_ns=40)] == gone


def test_when_no_file_is_being_written_none_goes_for_it() -> None:
    assert select_deletions(FILES, None, Limits(files=3, size_bytes=300), 40) == []
    assert [path.stem for path in select_deletions(FILES, None, Limits(files=2), 40)] == ["a"]


def test_the_last_recording_stays_however_large_it_is_and_goes_with_its_age() -> None:
    assert [path.stem for path in select_deletions(FILES, None, Limits(size_bytes=10), 40)] == ["a", "b"]
    assert [path.stem for path in select_deletions(FILES, None, Limits(age_ns=5), 40)] == ["a", "b", "c"]


def test_what_a_black_box_still_needs_stays() -> None:
    assert [path.stem for path in select_deletions(FILES, 50, Limits(files=1), 40, protected_since_ns=20)] == ["a"]


@given(
    ends=st.lists(st.integers(0, 100), max_size=8),
    sizes=st.lists(st.integers(0, 100), min_size=8, max_size=8),
    files=st.integers(1, 9),
    size=st.integers(0, 500),
)
def test_no_more_goes_than_has_to(ends: list[int], sizes: list[int], files: int, size: int) -> None:
    found = [CompleteRecording(Path(str(n)), sizes[n], end) for n, end in enumerate(ends)]
    gone = select_deletions(found, 0, Limits(size_bytes=size, files=files), 100)
    left = [item for item in found if item.path not in gone]
    assert len(left) + 1 <= files or not left
    assert sum(item.size_bytes for item in left) <= size or not left
    if gone:  # with the last of them back, it would be too much
        (back,) = (item for item in found if item.path == gone[-1])
        assert len(left) + 2 > files or sum(item.size_bytes for item in left) + back.size_bytes > size


N = 600


def raised(name: str = "ewma/T", event: str = "raised") -> messages.Alarm:
    return messages.Alarm(alarm=name, event=event)


def test_an_alarm_keeps_what_was_before_and_what_comes_after() -> None:
    box = BlackBox(N)
    assert box.on_message(raised(), 1000) is None
    assert box.pop_ended(1000 + N) is None
    assert box.next_due_ns == 1000 + N + 1
    assert box.pop_ended(1000 + N + 1) == AlarmInterval(400, 1600, 1000, "ewma/T")
    assert box.pop_ended(10_000) is None


def test_alarms_that_come_before_it_is_over_share_a_stretch() -> None:
    box = BlackBox(N)
    box.on_message(raised("ewma/T"), 1000)
    box.on_message(raised("shewhart/C"), 1500)
    assert box.pop_ended(1601) is None
    assert box.pop_ended(2101) == AlarmInterval(400, 2100, 1000, "ewma/T")


def test_alarms_without_an_end_do_not_make_a_stretch_without_an_end() -> None:
    box, kept = BlackBox(N), []
    for at in range(1000, 1000 + 3 * MAX_MARGINS * N, N // 2):
        over = box.on_message(raised(), at)
        if over is not None:
            kept.append(over)
    assert len(kept) >= 2
    assert all(stretch.to_ns - stretch.raised_ns <= MAX_MARGINS * N for stretch in kept)
    assert max(stretch.to_ns - stretch.from_ns for stretch in kept) == box.longest_ns
    for before, after in itertools.pairwise(kept):
        assert after.from_ns <= before.to_ns  # nothing between them is missing


def test_what_is_no_new_alarm_of_the_plant_keeps_nothing() -> None:
    box = BlackBox(N, own=("recording/disk",))
    for message in (raised(event="cleared"), raised("recording/disk"), messages.Sample(), messages.Health()):
        box.on_message(message, 1000)
    assert box.close() is None
    off = BlackBox(0)
    off.on_message(raised(), 1000)
    assert off.close() is None
    assert off.protected_ns(1000) is None


def test_what_it_may_still_need_is_known() -> None:
    box = BlackBox(N)
    assert box.protected_ns(5000) == N  # of an alarm that comes now
    box.on_message(raised(), 5000)
    assert box.protected_ns(5000) == N
    assert box.protected_ns(5500) == 500 + N
    assert box.close() == AlarmInterval(4400, 5600, 5000, "ewma/T")


def test_a_fleet_of_12_000_plants_has_room_for_five_keys_each() -> None:
    room = ChannelBudget(MAX_KEYS)
    assert all(
        room.admit(Channel(f"reactor/p{plant}/sample/{key}", "", is_product=True), 0)
        for plant in range(12_000)
        for key in range(5)
    )


def test_room_is_bounded_by_what_the_format_can_number() -> None:
    assert MAX_KEYS + MAX_OTHER_CHANNELS < MAX_CHANNELS


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
    assert not room.needs_new_file(Channel("weather/1", "", is_product=False), MINUTE_NS)
    assert room.needs_new_file(own[100], MINUTE_NS) == is_needed
    assert not room.needs_new_file(own[100], MINUTE_NS + 5 * SECOND_NS)  # asked once an interval


def remembered(*reported: tuple[str, Message], most: int = 100) -> LatchedMessages:
    head = LatchedMessages(most)
    for number, (key, message) in enumerate(reported):
        head.update(RecordedMessage(key, message.SerializeToString(), "?", number, 100 + number), message)
    return head


def test_the_last_message_of_each_model_alarm_and_fault_is_repeated_and_nothing_else() -> None:
    head = remembered(
        ("model/T", messages.ModelSnapshot(reference=True, rows=1)),
        ("model/T", messages.ModelSnapshot(reference=False, rows=2)),
        ("model/T", messages.ModelSnapshot(held=True, rows=2)),
        ("model/T", messages.ModelSnapshot(structure="equations", reference=True)),
        ("alarm/a", messages.Alarm(alarm="a", event="raised")),
        ("sample/T", messages.Sample(value=1.0)),
        ("health/monitor", messages.Health()),
        ("model/T", messages.ModelSnapshot(reference=False, rows=3)),
        ("fault/x", messages.Fault(cause="x")),
        ("alarm/a", messages.Alarm(alarm="a", event="cleared")),
    )
    entries = head.messages(1000)
    assert [entry.publish_time_ns - 100 for entry in entries] == [0, 2, 3, 7, 8, 9]
    assert {(entry.log_time_ns, entry.latched) for entry in entries} == {(1000, True)}


def test_an_incident_is_repeated_until_all_its_alarms_are_normal() -> None:
    """One of which an alarm has returned and was not acknowledged still waits for an operator, with its suspects."""
    first, over = (
        messages.Incident(number=1, alarms=["a"], until_ns=5, state=state)
        for state in (messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED, messages.ALARM_STATE_NORMAL)
    )
    second = messages.Incident(number=2, alarms=["b"], state=messages.ALARM_STATE_UNACKNOWLEDGED)
    active = remembered(("incident/1", first), ("incident/2", second)).messages(1000)
    assert [entry.key for entry in active] == ["incident/1", "incident/2"]
    later = remembered(("incident/1", first), ("incident/2", second), ("incident/1", over)).messages(1000)
    assert [entry.key for entry in later] == ["incident/2"]


def test_of_more_than_it_may_hold_the_oldest_are_forgotten() -> None:
    head = remembered(*((f"alarm/{number % 5}", messages.Alarm()) for number in range(20)), most=3)
    assert [entry.key for entry in head.messages(1000)] == ["alarm/2", "alarm/3", "alarm/4"]
