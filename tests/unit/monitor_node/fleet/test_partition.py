"""Who was cut off from the others judges nothing until he is back, and then goes on from what they have stored."""

import tracemalloc

import pytest

from monitor_node.fleet.sharding import Shard, home_shard
from monitor_node.ingest.pending import PlantHistory
from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import Alarm, Sample

from ..fleets import SECOND_NS, alarms, fleet, noting, of, row_by_row


def places_of(run: list[Encoded], time_ns: int) -> int:
    """Where in a run the row of a time begins."""
    return next(place for place, item in enumerate(run) if Sample.FromString(item.payload).time_ns == time_ns)


@pytest.mark.parametrize(("heard_the_other", "has_stored"), [(False, True), (True, True), (True, False)])
def test_who_was_cut_off_tells_no_alarm_again_that_another_has_told_and_loses_none(
    heard_the_other: bool, has_stored: bool, runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    """The leak sets in while the first is cut off; the second tells the alarms, but for the last.

    What the second knows may be on its way to the disk still when the first is back, but what it said is known.
    """
    run, at_home = runs["b"], home_shard("b", 2)
    told = [time_ns for _, _, time_ns in alarms(expected["b"])]
    cut_at, back_at = places_of(run, told[0]) - 30, places_of(run, told[-1])
    first, second = fleet(shard=Shard(at_home, 2), name="first", request_history=noting([])), fleet()
    first.on_alive("reactor/b/alive/plant", True, 0)
    said = first.on_history(PlantHistory("b", None, run[:cut_at]), 0)
    second.adopt("b", first.state_of("b"), 0)
    first.pause()
    others = second.on_messages(run[cut_at:back_at], 0)
    said += others
    assert (first.on_messages(run[cut_at:back_at], 0), first.on_tick(100 * SECOND_NS)) == ([], [])
    if heard_the_other:
        first.on_messages([encode(item) for item in others], 0)
    assert first.resume(["b"] if has_stored else [], 0) == []
    assert first.plants == []
    first.on_messages(run[back_at : back_at + 6], 0)
    said += first.on_history(PlantHistory("b", second.state_of("b"), run[: back_at + 6]), 0)
    said += first.on_messages(run[back_at + 6 :], 0)
    assert 1 < len(alarms(others)) < len(told)
    assert alarms(of("b", said)) == alarms(expected["b"])
    assert first.monitor("b").rows == len(run) // 3


def test_with_the_state_that_he_stored_himself_who_was_cut_off_tells_nothing_again_that_he_said_after_it(
    runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    run, raised_ns = runs["b"], alarms(expected["b"])[0][2]
    stored_at, cut_at = places_of(run, raised_ns) - 60, places_of(run, raised_ns) + 60
    monitor = fleet(request_history=noting([]))
    monitor.on_alive("reactor/b/alive/plant", True, 0)
    said = monitor.on_history(PlantHistory("b", None, run[:stored_at]), 0)
    state = monitor.state_of("b")
    said += monitor.on_messages(run[stored_at:cut_at], 0)
    monitor.rejoin("b", 0)
    said += monitor.on_history(PlantHistory("b", state, run[: cut_at + 30]), 0)
    said += monitor.on_messages(run[cut_at + 30 :], 0)
    assert alarms(of("b", said)) == alarms(expected["b"])


def test_of_plants_that_nobody_else_has_watched_what_came_meanwhile_is_judged_as_if_it_had_come_now(
    runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    monitor, messages = fleet(), row_by_row(runs.values())
    said = monitor.on_messages(messages[:2000], 0)
    monitor.pause()
    for place in range(2000, len(messages), 100):
        assert monitor.on_messages(messages[place : place + 100], 0) == []
    said += monitor.resume((), 0)
    for plant in runs:
        assert of(plant, said) == expected[plant]


def test_a_silence_that_who_was_cut_off_has_raised_is_over_with_the_next_sample(runs: dict[str, list[Encoded]]) -> None:
    """To him the plant was silent; the other, from whose state he goes on, has heard it all the time."""
    run, monitor = runs["a"], fleet(request_history=noting([]))
    monitor.on_alive("reactor/a/alive/plant", True, 0)
    monitor.on_history(PlantHistory("a", None, []), 0)
    for row in range(100):
        monitor.on_messages(run[3 * row : 3 * row + 3], row * SECOND_NS)
        monitor.on_tick(row * SECOND_NS)
    state, now_ns, said = monitor.state_of("a"), 99 * SECOND_NS, list[Publication]()
    while not alarms(said):
        now_ns += SECOND_NS // 10
        said += monitor.on_tick(now_ns)
    other = fleet()
    other.adopt("a", state, 0)
    other.on_messages(run[300:600], 0)
    monitor.rejoin("a", now_ns)
    said += monitor.on_history(PlantHistory("a", other.state_of("a"), run[:600]), now_ns)
    said += monitor.on_messages(run[600:603], now_ns)
    (raised, cleared) = [item.message for item in said if isinstance(item.message, Alarm)]
    assert (raised.event, cleared.event, cleared.raised_ns) == ("raised", "cleared", raised.raised_ns)


def test_what_is_too_large_takes_no_room_while_it_is_held_and_is_refused_afterwards(
    runs: dict[str, list[Encoded]],
) -> None:
    monitor = fleet()
    monitor.on_messages(runs["a"][:30], 0)
    monitor.pause()
    tracemalloc.start()
    try:
        for _ in range(100):
            monitor.on_message(runs["a"][0]._replace(payload=bytes(1_000_000)), 0)
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    monitor.resume((), 0)
    assert held < 1_000_000
    assert monitor.monitor("a").rejects.by_reason == {"too_large": 100}


def test_more_than_can_be_held_is_judged_rather_than_lost(
    runs: dict[str, list[Encoded]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("monitor_node.fleet.monitor.MOST_HELD", 60)
    monitor = fleet()
    monitor.pause()
    for message in runs["a"][:59]:
        monitor.on_message(message, 0)
    assert monitor.plants == []
    monitor.on_message(runs["a"][59], 0)
    assert (monitor.paused, monitor.monitor("a").rows) == (False, 20)
