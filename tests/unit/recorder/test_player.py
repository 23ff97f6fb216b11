"""Playing back: what is published, and when; from a given time on it starts with the active alarms."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Publication, encode
from reactorwatch.records.record import NEVER_NS, Record
from recorder import RecordedMessage
from recorder.keep import LATCHED_KINDS
from recorder.tools.player import BATCH, EVERYTHING, Player, filter_playable, filter_time, samples_of
from tests.unit.recorder import golden

SECOND = 10**9


def at(*seconds: float) -> Callable[[], Iterator[Publication]]:
    """A tape with a message at each of these times, of a plant that counts ten samples a second."""
    return lambda: (
        Publication("reactor/x/sample/T", messages.Sample(time_ns=round(second * SECOND), sequence=round(second * 10)))
        for second in seconds
    )


def stepped(player: Player, now_s: float, rows: int = 1) -> list[float]:
    """Sample times of the rows that steps publish."""
    steps = [player.step(round(now_s * SECOND)) for _ in range(rows)]
    return [publication.message.time_ns / SECOND for row in steps for publication in row]


def ticked(player: Player, now_s: float) -> list[float]:
    return [publication.message.time_ns / SECOND for publication in player.on_tick(round(now_s * SECOND))]


def played(player: Player, start_ns: int = 0) -> list[tuple[float, float]]:
    """(clock, sample time) in seconds of each message, by a clock that jumps from tick to tick."""
    now = start_ns
    out: list[tuple[float, float]] = []
    while not player.finished:
        now = max(now, player.next_tick_ns())
        out += [(now / SECOND, publication.message.time_ns / SECOND) for publication in player.on_tick(now)]
    return out


@pytest.mark.parametrize(
    ("rate", "clock"),
    [(1.0, [7, 8, 10, 17]), (2.0, [7, 7.5, 8.5, 12]), (0.1, [7, 17, 37, 107]), (math.inf, [7] * 4)],
)
def test_samples_go_out_at_the_pace_of_their_times(rate: float, clock: list[float]) -> None:
    assert played(Player(at(100, 101, 103, 110), rate), 7 * SECOND) == list(
        zip(clock, [100, 101, 103, 110], strict=True)
    )


def test_a_sample_that_is_older_than_the_one_before_goes_out_at_once_and_in_its_place() -> None:
    assert played(Player(at(0, 5, 3, 6), 1.0)) == [(0, 0), (5, 5), (5, 3), (6, 6)]


def test_a_player_that_was_held_up_catches_up() -> None:
    player = Player(at(0, 1, 2, 3), 1.0)
    assert len(player.on_tick(50 * SECOND)) == 1  # the play starts here
    assert len(player.on_tick(52 * SECOND + 1)) == 2
    assert not player.finished
    assert player.next_tick_ns() == 53 * SECOND


def test_the_loop_gets_a_word_in_between_batches() -> None:
    player = Player(at(*range(BATCH + 1)), math.inf)
    assert len(player.on_tick(5)) == BATCH
    assert player.next_tick_ns() <= 5
    assert len(player.on_tick(5)) == 1
    assert (player.finished, player.published) == (True, BATCH + 1)


def test_nothing_to_play_is_finished_at_once() -> None:
    assert Player(lambda: iter(()), 1.0).finished


def test_only_samples_go_out_unless_more_is_asked_for() -> None:
    kinds = {keys.parse(publication.key).kind for publication in filter_playable(golden.entries())}  # type: ignore[union-attr]
    assert kinds == {keys.SAMPLE}
    more = list(filter_playable(golden.entries(), kinds=EVERYTHING))
    assert [item.key for item in more] == [entry.key for entry in golden.entries() if keys.HEALTH not in entry.key]


def test_what_goes_out_is_what_was_recorded_byte_for_byte_under_the_name_asked_for() -> None:
    recorded = [entry for entry in golden.entries() if "/sample/" in entry.key]
    again = [encode(publication) for publication in filter_playable(golden.entries(), "twin")]
    assert [message.payload for message in again] == [entry.payload for entry in recorded]
    assert [message.key for message in again] == [entry.key.replace("cstr", "twin") for entry in recorded]


def test_what_cannot_be_decoded_or_is_no_publication_is_left_out() -> None:
    strange = [
        RecordedMessage("reactor/cstr/sample/T", b"\xff\xff", "application/protobuf;reactorwatch.v1.Sample", 0, 0),
        RecordedMessage("reactor/cstr/sample/T", b"", "text/plain", 0, 0),
        RecordedMessage("reactor/cstr/sample/T", b"", "application/protobuf;reactorwatch.v1.SetInput", 0, 0),
        RecordedMessage("reactor", b"", "application/protobuf;reactorwatch.v1.Sample", 0, 0),
    ]
    assert list(filter_playable(strange)) == []


def test_a_record_becomes_the_samples_of_a_plant() -> None:
    record = Record(
        np.array([0.1, 0.2]),
        {"qc": np.array([100.0, 101.0]), "C": np.array([np.nan, 0.2]), "T": np.array([438.0, 439.0])},
        "x",
        units={"qc": "l/min", "T": "degC"},
    )
    samples = [(item.key, item.message) for item in samples_of(record, "p", zero_ns=1000)]
    assert [
        (key, body.time_ns, body.sequence, body.value, body.unit)
        for key, body in samples
        if isinstance(body, messages.Sample) and body.quality == messages.QUALITY_GOOD
    ] == [
        ("reactor/p/sample/qc", 6_000_001_000, 0, 100.0, "l/min"),
        ("reactor/p/sample/T", 6_000_001_000, 0, 438.0, "degC"),
        ("reactor/p/sample/qc", 12_000_001_000, 1, 101.0, "l/min"),
        ("reactor/p/sample/C", 12_000_001_000, 0, 0.2, ""),
        ("reactor/p/sample/T", 12_000_001_000, 1, 439.0, "degC"),
    ]


def test_a_row_in_which_nothing_was_measured_has_bad_quality() -> None:
    record = Record(np.array([0.1]), {"qc": np.array([np.nan]), "T": np.array([np.nan])}, "x")
    ((key, body),) = samples_of(record, "p")
    assert key == "reactor/p/sample/qc"
    assert isinstance(body, messages.Sample)
    assert (body.quality, math.isnan(body.value)) == (messages.QUALITY_BAD, True)


def test_a_stretch_is_played_with_both_its_ends_at_the_times_of_its_samples() -> None:
    tape = at(0, 10, 11, 14, 15, 90)
    player = Player(lambda: filter_time(tape(), 10 * SECOND, 15 * SECOND), 1.0)
    assert played(player, 100 * SECOND) == [(100, 10), (101, 11), (104, 14), (105, 15)]


def test_a_loop_restarts_one_row_after_the_last_and_keeps_the_times_of_the_samples() -> None:
    player, now, out = Player(at(0, 0, 2, 4), 2.0, loop=True), 0, list[tuple[float, float]]()
    while len(out) < 9:
        now = max(now, player.next_tick_ns())
        out += [(now / SECOND, time) for time in ticked(player, now / SECOND)]
    assert out[:9] == [(0, 0), (0, 0), (1, 2), (2, 4), (3, 0), (3, 0), (4, 2), (5, 4), (6, 0)]
    assert not player.finished


def test_a_loop_as_fast_as_it_goes_leaves_the_loop_its_word() -> None:
    player = Player(at(0, 1), math.inf, loop=True)
    assert len(player.on_tick(5)) == BATCH
    assert len(player.on_tick(5)) == BATCH


def test_a_pause_holds_the_plants_time_and_the_rest_of_a_row_is_waited_for_afterwards() -> None:
    player = Player(at(0, 10, 20), 1.0)
    assert ticked(player, 0) == [0]
    player.set_pace(4 * SECOND, paused=True)
    assert player.next_tick_ns() >= NEVER_NS
    assert ticked(player, 500) == []
    player.set_pace(1000 * SECOND, paused=False)
    assert player.next_tick_ns() == 1006 * SECOND
    assert ticked(player, 1006) == [10]


def test_a_step_is_a_row_and_the_play_resumes_from_it() -> None:
    player = Player(at(0, 0, 10, 10, 20, 30), 1.0)
    player.set_pace(0, paused=True)
    assert [stepped(player, 1), stepped(player, 2, rows=2)] == [[0, 0], [10, 10, 20]]
    player.set_pace(50 * SECOND, paused=False)
    assert played(player, 50 * SECOND) == [(60, 30)]
    assert player.published == 6


def test_a_step_goes_over_the_end_of_a_loop_and_not_over_that_of_a_play() -> None:
    looped, once = Player(at(0, 1), 1.0, loop=True), Player(at(0, 1), 1.0)
    for player in (looped, once):
        player.set_pace(0, paused=True)
    assert stepped(looped, 1, rows=3) == [0, 1, 0]
    looped.set_pace(10 * SECOND, paused=False)
    assert looped.next_tick_ns() == 11 * SECOND
    assert stepped(once, 1, rows=3) == [0, 1]
    assert once.finished


def test_the_rate_changes_from_now_on() -> None:
    player = Player(at(0, 10, 20), 1.0)
    ticked(player, 0)
    player.set_pace(4 * SECOND, rate=0.5)
    assert played(player) == [(16, 10), (36, 20)]


def test_a_play_as_fast_as_it_goes_can_be_slowed_down() -> None:
    player = Player(at(*range(0, 10 * BATCH, 10), 10 * BATCH, 10 * BATCH + 10), math.inf)
    assert len(ticked(player, 7)) == BATCH
    player.set_pace(8 * SECOND, rate=5.0)
    assert played(player, 8 * SECOND) == [(8, 10 * BATCH), (10, 10 * BATCH + 10)]


def test_a_step_while_it_plays_publishes_nothing_and_changes_nothing() -> None:
    player = Player(at(0, 1), 1.0)
    assert player.step(0) == []
    assert played(player) == [(0, 0), (1, 1)]


SECOND_NS = 1_000_000_000
FROM_NS = 100 * SECOND_NS


def sampled(second: float) -> Publication:
    number = int(second)
    return Publication(
        keys.key("cstr", keys.SAMPLE, "T"),
        messages.Sample(time_ns=int(second * SECOND_NS), sequence=number, value=1.0, quality=messages.QUALITY_GOOD),
    )


def alarmed(second: float, name: str, state: Any) -> Publication:
    return Publication(
        keys.key("cstr", keys.ALARM, name), messages.Alarm(time_ns=int(second * SECOND_NS), alarm=name, state=state)
    )


STANDING = sorted({*messages.AlarmState.values()} - {messages.ALARM_STATE_NORMAL, messages.ALARM_STATE_UNSPECIFIED})


def recorded_tape() -> Iterator[Publication]:
    for second in range(200):
        yield sampled(second)
        if second == 40:
            yield from (alarmed(second, f"a{state}", state) for state in STANDING)
            yield alarmed(second, "was", messages.ALARM_STATE_UNACKNOWLEDGED)
            yield alarmed(second, "changed", messages.ALARM_STATE_UNACKNOWLEDGED)
        if second == 60:
            yield alarmed(second, "was", messages.ALARM_STATE_NORMAL)
            yield alarmed(second, "changed", messages.ALARM_STATE_ACKNOWLEDGED)
        if second == 150:
            yield alarmed(second, "later", messages.ALARM_STATE_UNACKNOWLEDGED)


def test_the_newest_message_of_each_standing_alarm_comes_before_the_first_sample() -> None:
    played = list(filter_time(recorded_tape(), FROM_NS, 2 * FROM_NS))
    names = [item.message.alarm for item in played[: len(STANDING) + 1] if isinstance(item.message, messages.Alarm)]
    assert sorted(names) == sorted([*(f"a{state}" for state in STANDING), "changed"])
    states = {
        item.message.state for item in played if isinstance(item.message, messages.Alarm) and "changed" in item.key
    }
    assert states == {messages.ALARM_STATE_ACKNOWLEDGED}
    rest = [item for item in played[len(names) :] if not item.key.endswith("later")]
    assert rest == [sampled(second) for second in range(100, 200)]


def test_from_the_start_nothing_is_published_before_it() -> None:
    assert list(filter_time(recorded_tape(), 0, 2 * FROM_NS)) == list(recorded_tape())


@pytest.mark.parametrize("rate", [1.0, 60.0])
def test_standing_alarms_are_due_with_the_first_sample(rate: float) -> None:
    player = Player(lambda: filter_time(recorded_tape(), FROM_NS, 2 * FROM_NS), rate)
    first = player.on_tick(0)
    assert len(first) == len(STANDING) + 2
    assert first[-1] == sampled(100)
    assert player.next_tick_ns() == round(SECOND_NS / rate)


@pytest.mark.parametrize("kind", LATCHED_KINDS)
def test_latched_messages_of_every_kind_are_due_with_the_first_sample(kind: str) -> None:
    latched = Publication(keys.key("cstr", kind, "x"), LATCHED_KINDS[kind](time_ns=0))  # type: ignore[arg-type]
    stated = list[float]()
    player = Player(lambda: iter([latched, sampled(18_000), sampled(18_001)]), 1.0, on_wait=stated.append)
    assert player.on_tick(0) == [latched, sampled(18_000)]
    assert player.next_tick_ns() == SECOND_NS
    assert not stated


@pytest.mark.parametrize(
    ("seconds", "rate", "waits"),
    [
        ([0, 1, 2, 3], 1.0, []),
        ([0, 1, 2, 3602], 1.0, [3600.0]),
        ([0, 1, 2, 3602], 60.0, []),  # a minute
        ([0, 1, 2, 36002], 60.0, [600.0]),
        ([0, 1, 2, 63], 1.0, [61.0]),
        ([0, 90, 180, 270], 1.0, [90.0]),  # the first wait: what is usual is not known yet
        ([0, 1, 2, 3602], float("inf"), []),
    ],
)
def test_a_wait_of_more_than_a_minute_for_a_jump_of_the_clock_is_reported(
    seconds: list[float], rate: float, waits: list[float]
) -> None:
    stated = list[float]()
    player = Player(lambda: iter([sampled(second) for second in seconds]), rate, on_wait=stated.append)
    now_ns = 0
    while not player.finished:
        player.on_tick(now_ns)
        now_ns = max(now_ns, player.next_tick_ns())
    assert stated == pytest.approx(waits)
