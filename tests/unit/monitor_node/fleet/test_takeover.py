"""Monitors that share a fleet take plants over from each other: no alarm is lost, and none told twice."""

import pytest

from monitor_node.fleet.sharding import Shard, home_shard
from monitor_node.ingest.pending import PlantHistory
from reactorwatch.contract.codec import Encoded, Publication, encode, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Health, Sample

from ..fleets import SECOND_NS, alarms, fleet, noting, of, run_of, shard_token


def test_plants_of_a_shard_that_is_gone_are_taken_over_and_given_back() -> None:
    at_home = home_shard("a", 2)
    monitor = fleet(shard=Shard(3 - at_home, 2), name="us")
    monitor.on_alive(shard_token(at_home), True, 0)
    monitor.on_alive("reactor/a/alive/plant", True, 0)
    assert monitor.plants == []
    monitor.on_alive(shard_token(at_home), False, 0)
    assert monitor.plants == ["a"]
    monitor.on_alive(shard_token(at_home), True, 0)
    assert monitor.plants == []


def test_a_shard_that_never_came_is_taken_over_after_a_while() -> None:
    monitor = fleet(shard=Shard(3 - home_shard("a", 2), 2))
    monitor.on_alive("reactor/a/alive/plant", True, 0)
    monitor.on_tick(9 * SECOND_NS)
    assert monitor.plants == []
    monitor.on_tick(10 * SECOND_NS)
    assert monitor.plants == ["a"]


def test_an_alarm_that_stands_is_not_raised_again_by_who_takes_over_and_is_cleared_when_it_is_over() -> None:
    run = run_of("b", 2)
    monitor = fleet(shard=Shard(3 - home_shard("b", 2), 2))
    state = AlarmState.ALARM_STATE_UNACKNOWLEDGED
    standing = Alarm(time_ns=1, alarm="ewma/T", state=state, raised_ns=1, incident=4, first_in=True, limit=1.0)
    payload, encoding = encode_message(standing)
    monitor.on_alive(shard_token(home_shard("b", 2)), True, 0)
    monitor.on_message(Encoded("reactor/b/alarm/ewma/T", payload, encoding), 0)
    monitor.on_alive(shard_token(home_shard("b", 2)), False, 0)
    said = [item for message in run for item in monitor.on_message(message, 0)]
    assert [(key, event) for key, event, _ in alarms(said)] == [("reactor/b/alarm/ewma/T", "cleared")]


@pytest.mark.parametrize("told_again", [0, 50])
def test_with_the_state_of_who_died_no_alarm_is_lost_and_none_is_told_twice(
    told_again: int, runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    run, at_home = runs["b"], home_shard("b", 2)
    raised_ns = next(time_ns for _, _, time_ns in alarms(expected["b"]))
    raised_at = next(place for place, item in enumerate(run) if Sample.FromString(item.payload).time_ns == raised_ns)
    stored_at, died_at = raised_at - 90, raised_at + 30
    first = fleet(shard=Shard(at_home, 2), name="first")
    said = first.on_messages(run[:stored_at], 0)
    state = first.monitor("b").to_bytes()
    said += first.on_messages(run[stored_at:died_at], 0)
    asked: list[tuple[str, bool]] = []
    second = fleet(
        shard=Shard(3 - at_home, 2),
        name="second",
        request_history=noting(asked),
    )
    second.on_alive(shard_token(at_home), True, 0)
    for publication in said:
        second.on_message(encode(publication), 0)
    second.on_alive(shard_token(at_home), False, 0)
    assert asked == [("b", True)]
    second.on_messages(run[died_at - 5 : died_at + 3], 0)  # before the past is known
    remembered = run[stored_at - told_again : died_at]
    said += second.on_history(PlantHistory("b", state, remembered), 0)
    said += second.on_messages(run[died_at + 3 :], 0)
    assert [item for item in of("b", said) if isinstance(item.message, Alarm)] == [
        item for item in expected["b"] if isinstance(item.message, Alarm)
    ]


@pytest.mark.parametrize("stale_rows", [20, 60])
def test_rows_that_were_told_when_a_plant_was_taken_over_and_come_by_themselves_later_are_not_judged_again(
    stale_rows: int, runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    """More of them than rows may be late look like a plant whose clock was set back."""
    run, at_home, said = runs["b"], home_shard("b", 2), list[Publication]()
    taken_at, resumed_at = 3 * 250, 3 * 255
    second = fleet(shard=Shard(3 - at_home, 2), request_history=noting([]))
    second.on_alive(shard_token(at_home), True, 0)
    second.on_alive("reactor/b/alive/plant", True, 0)
    second.on_alive(shard_token(at_home), False, 0)
    said += second.on_history(PlantHistory("b", None, run[:taken_at]), 0)
    said += second.on_messages(run[taken_at:resumed_at], 0)
    again = run[taken_at - 3 * stale_rows : taken_at]
    said += second.on_messages(again, 0)
    said += second.on_messages(run[resumed_at:], 0)
    (health,) = [
        item.message
        for item in second.on_stop(0)
        if isinstance(item.message, Health) and item.key.startswith("reactor/b/")
    ]
    assert (health.rows, health.incomplete_rows, health.duplicated) == (len(run) // 3, 0, len(again))
    assert alarms(of("b", said)) == alarms(expected["b"])


def test_a_plant_that_is_started_anew_is_heard_though_it_was_taken_over_just_before() -> None:
    at_home = home_shard("b", 2)
    second = fleet(shard=Shard(3 - at_home, 2), request_history=noting([]))
    second.on_alive(shard_token(at_home), True, 0)
    second.on_alive("reactor/b/alive/plant", True, 0)
    second.on_alive(shard_token(at_home), False, 0)
    run = run_of("b", 2)
    second.on_history(PlantHistory("b", None, run[:300]), 0)
    for anew_ns, rows in ((0, 100), (61 * SECOND_NS, 200)):  # while it may be the same ones, and afterwards
        second.on_messages(run[:300], anew_ns)
        assert second.monitor("b").rows == rows


def test_alarms_of_a_plant_whose_clock_is_set_back_are_published_though_the_predecessor_s_are_later(
    runs: dict[str, list[Encoded]],
) -> None:
    run, at_home, alone = runs["b"], home_shard("b", 2), fleet()
    later = [shifted(message, 10_000 * SECOND_NS) for message in run]
    second = fleet(shard=Shard(3 - at_home, 2), request_history=noting([]))
    second.on_alive(shard_token(at_home), True, 0)
    for item in alone.on_messages(later, 0):
        second.on_message(encode(item), 0)
    second.on_alive(shard_token(at_home), False, 0)
    second.on_history(PlantHistory("b", alone.state_of("b"), later), 0)
    published, expected = (monitor.on_messages(run, 61 * SECOND_NS) for monitor in (second, alone))
    assert alarms(published) == alarms(expected) != []


def shifted(message: Encoded, by_ns: int) -> Encoded:
    sample = Sample.FromString(message.payload)
    sample.time_ns += by_ns
    return message._replace(payload=sample.SerializeToString())


def test_a_silence_that_was_raised_after_the_state_was_stored_is_cleared_by_who_goes_on_from_it() -> None:
    """It was raised by the clock of receipt; in the samples there is none, so nothing else tells that it is over."""
    run, at_home = run_of("b", 2), home_shard("b", 2)
    first = fleet(shard=Shard(at_home, 2), name="first")
    first.on_messages(run[:300], 0)
    state, last_ns = first.monitor("b").to_bytes(), first.monitor("b").memory.last_ns
    assert last_ns is not None
    raised_ns = last_ns + 30 * SECOND_NS
    silent = Alarm(time_ns=raised_ns, alarm="silence/plant", event="raised", raised_ns=raised_ns)
    silent.state = AlarmState.ALARM_STATE_UNACKNOWLEDGED
    payload, encoding = encode_message(silent)
    second = fleet(shard=Shard(3 - at_home, 2), name="second", request_history=noting([]))
    second.on_alive(shard_token(at_home), True, 0)
    second.on_message(Encoded("reactor/b/alarm/silence/plant", payload, encoding), 0)
    second.on_alive(shard_token(at_home), False, 0)
    said = second.on_history(PlantHistory("b", state, run[:300]), 0)
    said += [item for message in run[300:] for item in second.on_message(message, 0)]
    assert alarms(said) == [("reactor/b/alarm/silence/plant", "cleared", raised_ns)]


@pytest.mark.parametrize("way", ["with a state", "without", "with a newer state then"])
def test_a_silence_that_the_other_raised_is_ended_though_rows_from_before_it_are_judged_first(way: str) -> None:
    """The state is of row 100, the silence of row 110, and rows up to 120 are told with the past: row 115 ends it."""
    run, at_home, said = run_of("b", 2), home_shard("b", 2), list[Publication]()
    first = fleet(shard=Shard(at_home, 2), name="first")
    first.on_messages(run[:300], 0)
    state = first.monitor("b").to_bytes()
    first.on_messages(run[300:330], 0)
    first_ns = Sample.FromString(run[0].payload).time_ns
    raised_ns = first_ns + 114 * (Sample.FromString(run[3].payload).time_ns - first_ns)
    silent = Alarm(time_ns=raised_ns, alarm="silence/plant", event="raised", raised_ns=raised_ns)
    silent.state = AlarmState.ALARM_STATE_UNACKNOWLEDGED
    payload, encoding = encode_message(silent)
    second = fleet(shard=Shard(3 - at_home, 2), name="second", request_history=noting([]))
    second.on_alive(shard_token(at_home), True, 0)
    second.on_message(Encoded("reactor/b/alarm/silence/plant", payload, encoding), 0)
    second.on_alive(shard_token(at_home), False, 0)
    said += second.on_history(PlantHistory("b", None if way == "without" else state, run[:360]), 0)
    if way == "with a newer state then":
        second.rejoin("b", 0)
        said += second.on_history(PlantHistory("b", first.state_of("b"), run[:360]), 0)
    said += second.on_messages(run[360:], 0)
    ((key, event, time_ns),) = alarms(said)
    assert (key, event) == ("reactor/b/alarm/silence/plant", "cleared")
    assert time_ns >= raised_ns


def test_a_silence_that_only_the_newer_state_knows_is_ended_though_later_rows_were_judged_from_an_older_one() -> None:
    """The silence was raised after row 110; who came back has judged up to row 120 before he finds the newer state."""
    run = run_of("b", 2)
    first = fleet()
    for row in range(110):
        first.on_messages(run[3 * row : 3 * row + 3], row * SECOND_NS)
        first.on_tick(row * SECOND_NS)
    older, now_ns, said = first.state_of("b"), 109 * SECOND_NS, list[Publication]()
    while not alarms(said):
        now_ns += SECOND_NS // 10
        said += first.on_tick(now_ns)
    second = fleet(request_history=noting([]))
    second.on_alive("reactor/b/alive/plant", True, 0)
    said += second.on_history(PlantHistory("b", older, run[:360]), 0)
    second.rejoin("b", 0)
    said += second.on_history(PlantHistory("b", first.state_of("b"), run[:360]), 0)
    said += second.on_messages(run[360:], 0)
    assert [event for _, event, _ in alarms(said)] == ["raised", "cleared"]


def test_a_state_that_cannot_be_used_is_told_and_the_plant_learned_anew(runs: dict[str, list[Encoded]]) -> None:
    asked: list[tuple[str, bool]] = []
    monitor = fleet(request_history=noting(asked), unusable=lambda plant, _: f"; {plant} is kept aside")
    monitor.on_alive("reactor/a/alive/plant", True, 0)
    assert (asked, monitor.plants) == ([("a", False)], [])
    monitor.on_history(PlantHistory("a", b"rubbish", runs["a"][:30]), 0)
    assert (monitor.plants, monitor.monitor("a").rows) == (["a"], 10)
    ((plant, line),) = monitor.watched.reports(0)
    assert plant == "a"
    assert "learned again; a is kept aside" in line


def test_what_is_told_of_a_plant_that_is_anothers_by_then_is_passed_over() -> None:
    at_home = home_shard("a", 2)
    monitor = fleet(shard=Shard(3 - at_home, 2), name="us", request_history=lambda _plant, _taken_over: True)
    monitor.on_alive(shard_token(at_home), True, 0)
    monitor.on_alive("reactor/a/alive/plant", True, 0)
    monitor.on_alive(shard_token(at_home), False, 0)
    monitor.on_alive(shard_token(at_home), True, 0)
    assert monitor.on_history(PlantHistory("a", None, []), 0) == []
    assert monitor.plants == []


def test_a_plant_that_is_given_back_is_stored(runs: dict[str, list[Encoded]]) -> None:
    at_home, stored = home_shard("a", 2), dict[str, bytes]()
    monitor = fleet(shard=Shard(3 - at_home, 2), name="us", store=stored.__setitem__)
    monitor.on_alive(shard_token(at_home), True, 0)
    monitor.on_alive("reactor/a/alive/plant", True, 0)
    monitor.on_alive(shard_token(at_home), False, 0)
    monitor.on_messages(runs["a"][:30], 0)
    state = monitor.state_of("a")
    monitor.on_alive(shard_token(at_home), True, 0)
    assert stored == {"a": state}


def test_what_is_released_can_be_adopted(
    runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    first, second, half = fleet(), fleet(), len(runs["b"]) // 2
    said = first.on_messages(runs["b"][:half], 0)
    second.adopt("b", first.release("b"), 0)
    assert first.plants == []
    said += second.on_messages(runs["b"][half:], 0)
    assert of("b", said) == expected["b"]


# --- names that somebody has made up -----------------------------------------------------------------------------

TEN_MINUTES_NS = 600 * SECOND_NS
