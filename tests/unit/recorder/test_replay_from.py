"""A replay from a given time starts with the active alarms, and reports a long wait."""

from collections.abc import Iterator
from typing import Any

import pytest

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import Publication
from reactorwatch.records.record import MINUTE_NS
from recorder.keep import LATCHED_KINDS
from recorder.tools.player import LONG_WAIT_NS, Player, filter_time

SECOND_NS = 1_000_000_000
FROM_NS = 100 * SECOND_NS


def sample(second: float) -> Publication:
    number = int(second)
    return Publication(
        keys.key("cstr", keys.SAMPLE, "T"),
        messages.Sample(time_ns=int(second * SECOND_NS), sequence=number, value=1.0, quality=messages.QUALITY_GOOD),
    )


def alarm(second: float, name: str, state: Any) -> Publication:
    return Publication(
        keys.key("cstr", keys.ALARM, name), messages.Alarm(time_ns=int(second * SECOND_NS), alarm=name, state=state)
    )


STANDING = sorted({*messages.AlarmState.values()} - {messages.ALARM_STATE_NORMAL, messages.ALARM_STATE_UNSPECIFIED})


def tape() -> Iterator[Publication]:
    for second in range(200):
        yield sample(second)
        if second == 40:
            yield from (alarm(second, f"a{state}", state) for state in STANDING)
            yield alarm(second, "was", messages.ALARM_STATE_UNACKNOWLEDGED)
            yield alarm(second, "changed", messages.ALARM_STATE_UNACKNOWLEDGED)
        if second == 60:
            yield alarm(second, "was", messages.ALARM_STATE_NORMAL)
            yield alarm(second, "changed", messages.ALARM_STATE_ACKNOWLEDGED)
        if second == 150:
            yield alarm(second, "later", messages.ALARM_STATE_UNACKNOWLEDGED)


def test_the_newest_message_of_each_standing_alarm_comes_before_the_first_sample() -> None:
    played = list(filter_time(tape(), FROM_NS, 2 * FROM_NS))
    names = [item.message.alarm for item in played[: len(STANDING) + 1] if isinstance(item.message, messages.Alarm)]
    assert sorted(names) == sorted([*(f"a{state}" for state in STANDING), "changed"])
    states = {
        item.message.state for item in played if isinstance(item.message, messages.Alarm) and "changed" in item.key
    }
    assert states == {messages.ALARM_STATE_ACKNOWLEDGED}
    rest = [item for item in played[len(names) :] if not item.key.endswith("later")]
    assert rest == [sample(second) for second in range(100, 200)]


def test_from_the_start_nothing_is_published_before_it() -> None:
    assert list(filter_time(tape(), 0, 2 * FROM_NS)) == list(tape())


@pytest.mark.parametrize("rate", [1.0, 60.0])
def test_standing_alarms_are_due_with_the_first_sample(rate: float) -> None:
    player = Player(lambda: filter_time(tape(), FROM_NS, 2 * FROM_NS), rate)
    first = player.on_tick(0)
    assert len(first) == len(STANDING) + 2
    assert first[-1] == sample(100)
    assert player.next_tick_ns() == round(SECOND_NS / rate)


@pytest.mark.parametrize("kind", LATCHED_KINDS)
def test_latched_messages_of_every_kind_are_due_with_the_first_sample(kind: str) -> None:
    latched = Publication(keys.key("cstr", kind, "x"), LATCHED_KINDS[kind](time_ns=0))  # type: ignore[arg-type]
    said = list[float]()
    player = Player(lambda: iter([latched, sample(18_000), sample(18_001)]), 1.0, on_wait=said.append)
    assert player.on_tick(0) == [latched, sample(18_000)]
    assert player.next_tick_ns() == SECOND_NS
    assert not said


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
    said = list[float]()
    player = Player(lambda: iter([sample(second) for second in seconds]), rate, on_wait=said.append)
    now_ns = 0
    while not player.finished:
        player.on_tick(now_ns)
        now_ns = max(now_ns, player.next_tick_ns())
    assert said == pytest.approx(waits)


def test_a_long_wait_is_a_minute() -> None:
    assert LONG_WAIT_NS == MINUTE_NS == 60 * SECOND_NS
