"""The watch over a fleet: each plant is watched as if it were alone, by one monitor."""

import tracemalloc
from collections.abc import Callable

import pytest

from monitor_node.arrivals import Past
from monitor_node.config import MonitorConfig
from monitor_node.fleet.shards import Crew, Shard, home
from reactorwatch.contract.codec import Encoded, Publication, encode, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, AlarmCommand, AlarmState, CommandReply, Health, Sample
from reactorwatch.errors import InputError

from .fleets import PLANTS, QUICK, alone, fleet, of, row_by_row, run_of

SECOND_NS = 1_000_000_000


def alarms(said: list[Publication]) -> list[tuple[str, str, int]]:
    return [(i.key, i.message.event, i.message.time_ns) for i in said if isinstance(i.message, Alarm)]


@pytest.fixture(scope="module")
def runs() -> dict[str, list[Encoded]]:
    """Three plants; one leaks."""
    return {"a": run_of("a", 1), "b": run_of("b", 2, leak_min=30.0), "c": run_of("c", 3)}


@pytest.fixture(scope="module")
def expected(runs: dict[str, list[Encoded]]) -> dict[str, list[Publication]]:
    return {plant: alone(plant, run) for plant, run in runs.items()}


def test_each_plant_is_watched_as_if_it_were_alone(
    runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    monitor = fleet()
    said = [item for message in row_by_row(runs.values()) for item in monitor.on_message(message, 0)]
    assert alarms(expected["b"])
    for plant in runs:
        assert of(plant, said) == expected[plant]


def test_many_messages_together_say_what_each_would_alone(
    runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    monitor, messages, said = fleet(), row_by_row(runs.values()), list[Publication]()
    for begin in range(0, len(messages), 700):
        said += monitor.on_messages(messages[begin : begin + 700], 0)
    for plant in runs:
        assert of(plant, said) == expected[plant]


def test_a_plant_is_watched_as_soon_as_a_node_of_it_is_alive() -> None:
    shown: list[tuple[str, bool]] = []
    monitor = fleet(in_charge=lambda plant, ours: shown.append((plant, ours)))
    monitor.on_alive("reactor/x/alive/plant", True, 0)
    assert monitor.plants == ["x"]
    assert shown == [("x", True)]


def test_a_plant_whose_node_goes_is_still_watched() -> None:
    monitor = fleet()
    monitor.on_alive("reactor/x/alive/plant", True, 0)
    monitor.on_alive("reactor/x/alive/plant", False, 1)
    assert monitor.plants == ["x"]


@pytest.mark.parametrize("key", ["weather/x/sample/T", "reactor/x/health/plant", "reactor/@fleet/sample/T"])
def test_what_is_no_sample_of_a_plant_makes_no_plant(key: str) -> None:
    monitor = fleet()
    assert monitor.on_message(Encoded(key, b"", ""), 0) == []
    assert monitor.plants == []


def test_the_health_of_each_plants_monitor_is_told() -> None:
    monitor = fleet()
    for plant in ("x", "y"):
        monitor.on_alive(f"reactor/{plant}/alive/plant", True, 0)
    told = [item.key for item in monitor.on_tick(SECOND_NS) if isinstance(item.message, Health)]
    assert sorted(told) == ["reactor/x/health/monitor", "reactor/y/health/monitor"]
    assert monitor.next_tick_ns() == SECOND_NS + int(QUICK.health_period_s * 1e9)


def test_a_plant_that_falls_silent_is_told_of_while_others_go_on(runs: dict[str, list[Encoded]]) -> None:
    monitor = fleet()
    for number in range(200):  # rows
        now_ns = number * SECOND_NS
        for plant in ("a", "c") if number < 100 else ("c",):
            monitor.on_messages(runs[plant][3 * number : 3 * number + 3], now_ns)
        silent = [item for item in monitor.on_tick(now_ns) if isinstance(item.message, Alarm)]
        if silent:
            break
    assert [item.key for item in silent] == ["reactor/a/alarm/silence/plant"]
    assert number > 100


def test_a_command_goes_to_its_plant_and_to_who_watches_it(runs: dict[str, list[Encoded]]) -> None:
    monitor = fleet(shard=Shard(home("a", 2), 2))
    payload, encoding = encode_message(AlarmCommand(alarm="ewma/T", by="Ada", comment="seen"))
    monitor.on_messages(runs["a"][:3] + runs["a"][3:6], 0)
    reply, _ = monitor.on_command(Encoded("reactor/a/command/comment", payload, encoding), 0)
    assert isinstance(reply, CommandReply)
    assert reply.accepted
    theirs = next(name for name in map(str, range(99)) if home(name, 2) != home("a", 2))
    assert monitor.on_command(Encoded(f"reactor/{theirs}/command/comment", payload, encoding), 0) == (None, [])


def test_settings_that_make_no_monitor_are_refused_before_there_is_a_plant() -> None:
    with pytest.raises(InputError, match="reference"):
        fleet(config=MonitorConfig(outputs=("pressure",), priorities={}, reference="process"))


# --- sharing -----------------------------------------------------------------------------------------------------


def test_shards_together_say_of_each_plant_what_one_monitor_says_once(
    runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    monitors = [fleet(shard=Shard(number, 3), name=str(number)) for number in (1, 2, 3)]
    said = [item for message in row_by_row(runs.values()) for each in monitors for item in each.on_message(message, 0)]
    assert sorted(plant for each in monitors for plant in each.plants) == ["a", "b", "c"]
    for plant in runs:
        assert of(plant, said) == expected[plant]


def noting(asked: list[tuple[str, bool]]) -> Callable[[str, bool], bool]:
    """Notes whose past is asked for, and promises that it will be told."""

    def ask_past(plant: str, taken_over: bool) -> bool:
        asked.append((plant, taken_over))
        return True

    return ask_past


def shard_token(number: int) -> str:
    return Crew(PLANTS, Shard(number, 2), str(number)).token


def test_plants_of_a_shard_that_is_gone_are_taken_over_and_given_back() -> None:
    at_home = home("a", 2)
    monitor = fleet(shard=Shard(3 - at_home, 2), name="us")
    monitor.on_alive(shard_token(at_home), True, 0)
    monitor.on_alive("reactor/a/alive/plant", True, 0)
    assert monitor.plants == []
    monitor.on_alive(shard_token(at_home), False, 0)
    assert monitor.plants == ["a"]
    monitor.on_alive(shard_token(at_home), True, 0)
    assert monitor.plants == []


def test_a_shard_that_never_came_is_taken_over_after_a_while() -> None:
    monitor = fleet(shard=Shard(3 - home("a", 2), 2))
    monitor.on_alive("reactor/a/alive/plant", True, 0)
    monitor.on_tick(9 * SECOND_NS)
    assert monitor.plants == []
    monitor.on_tick(10 * SECOND_NS)
    assert monitor.plants == ["a"]


def test_an_alarm_that_stands_is_not_raised_again_by_who_takes_over_and_is_cleared_when_it_is_over() -> None:
    run = run_of("b", 2)
    monitor = fleet(shard=Shard(3 - home("b", 2), 2))
    state = AlarmState.ALARM_STATE_UNACKNOWLEDGED
    standing = Alarm(time_ns=1, alarm="ewma/T", state=state, raised_ns=1, incident=4, first_in=True, limit=1.0)
    payload, encoding = encode_message(standing)
    monitor.on_alive(shard_token(home("b", 2)), True, 0)
    monitor.on_message(Encoded("reactor/b/alarm/ewma/T", payload, encoding), 0)
    monitor.on_alive(shard_token(home("b", 2)), False, 0)
    said = [item for message in run for item in monitor.on_message(message, 0)]
    assert [(key, event) for key, event, _ in alarms(said)] == [("reactor/b/alarm/ewma/T", "cleared")]


@pytest.mark.parametrize("told_again", [0, 50])
def test_with_the_state_of_who_died_no_alarm_is_lost_and_none_is_told_twice(
    told_again: int, runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    run, at_home = runs["b"], home("b", 2)
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
        ask_past=noting(asked),
    )
    second.on_alive(shard_token(at_home), True, 0)
    for publication in said:
        second.on_message(encode(publication), 0)
    second.on_alive(shard_token(at_home), False, 0)
    assert asked == [("b", True)]
    second.on_messages(run[died_at - 5 : died_at + 3], 0)  # before the past is known
    remembered = run[stored_at - told_again : died_at]
    said += second.on_past(Past("b", state, remembered), 0)
    said += second.on_messages(run[died_at + 3 :], 0)
    assert [item for item in of("b", said) if isinstance(item.message, Alarm)] == [
        item for item in expected["b"] if isinstance(item.message, Alarm)
    ]


@pytest.mark.parametrize("stale_rows", [20, 60])
def test_rows_that_were_told_when_a_plant_was_taken_over_and_come_by_themselves_later_are_not_judged_again(
    stale_rows: int, runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    """More of them than rows may be late look like a plant whose clock was set back."""
    run, at_home, said = runs["b"], home("b", 2), list[Publication]()
    taken_at, resumed_at = 3 * 250, 3 * 255
    second = fleet(shard=Shard(3 - at_home, 2), ask_past=noting([]))
    second.on_alive(shard_token(at_home), True, 0)
    second.on_alive("reactor/b/alive/plant", True, 0)
    second.on_alive(shard_token(at_home), False, 0)
    said += second.on_past(Past("b", None, run[:taken_at]), 0)
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
    at_home = home("b", 2)
    second = fleet(shard=Shard(3 - at_home, 2), ask_past=noting([]))
    second.on_alive(shard_token(at_home), True, 0)
    second.on_alive("reactor/b/alive/plant", True, 0)
    second.on_alive(shard_token(at_home), False, 0)
    run = run_of("b", 2)
    second.on_past(Past("b", None, run[:300]), 0)
    for anew_ns, rows in ((0, 100), (61 * SECOND_NS, 200)):  # while it may be the same ones, and afterwards
        second.on_messages(run[:300], anew_ns)
        assert second.monitor("b").rows == rows


def test_a_silence_that_was_raised_after_the_state_was_stored_is_cleared_by_who_goes_on_from_it() -> None:
    """It was raised by the clock of receipt; in the samples there is none, so nothing else tells that it is over."""
    run, at_home = run_of("b", 2), home("b", 2)
    first = fleet(shard=Shard(at_home, 2), name="first")
    first.on_messages(run[:300], 0)
    state, last_ns = first.monitor("b").to_bytes(), first.monitor("b").last_ns
    assert last_ns is not None
    raised_ns = last_ns + 30 * SECOND_NS
    silent = Alarm(time_ns=raised_ns, alarm="silence/plant", event="raised", raised_ns=raised_ns)
    silent.state = AlarmState.ALARM_STATE_UNACKNOWLEDGED
    payload, encoding = encode_message(silent)
    second = fleet(shard=Shard(3 - at_home, 2), name="second", ask_past=noting([]))
    second.on_alive(shard_token(at_home), True, 0)
    second.on_message(Encoded("reactor/b/alarm/silence/plant", payload, encoding), 0)
    second.on_alive(shard_token(at_home), False, 0)
    said = second.on_past(Past("b", state, run[:300]), 0)
    said += [item for message in run[300:] for item in second.on_message(message, 0)]
    assert alarms(said) == [("reactor/b/alarm/silence/plant", "cleared", raised_ns)]


@pytest.mark.parametrize("way", ["with a state", "without", "with a newer state then"])
def test_a_silence_that_the_other_raised_is_ended_though_rows_from_before_it_are_judged_first(way: str) -> None:
    """The state is of row 100, the silence of row 110, and rows up to 120 are told with the past; 121 is the next."""
    run, at_home, said = run_of("b", 2), home("b", 2), list[Publication]()
    first = fleet(shard=Shard(at_home, 2), name="first")
    first.on_messages(run[:300], 0)
    state = first.monitor("b").to_bytes()
    first.on_messages(run[300:330], 0)
    first_ns = Sample.FromString(run[0].payload).time_ns
    raised_ns = first_ns + 114 * (Sample.FromString(run[3].payload).time_ns - first_ns)
    silent = Alarm(time_ns=raised_ns, alarm="silence/plant", event="raised", raised_ns=raised_ns)
    silent.state = AlarmState.ALARM_STATE_UNACKNOWLEDGED
    payload, encoding = encode_message(silent)
    second = fleet(shard=Shard(3 - at_home, 2), name="second", ask_past=noting([]))
    second.on_alive(shard_token(at_home), True, 0)
    second.on_message(Encoded("reactor/b/alarm/silence/plant", payload, encoding), 0)
    second.on_alive(shard_token(at_home), False, 0)
    said += second.on_past(Past("b", None if way == "without" else state, run[:360]), 0)
    if way == "with a newer state then":
        second.rejoin("b", 0)
        said += second.on_past(Past("b", first.state_of("b"), run[:360]), 0)
    assert alarms(said) == []
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
    second = fleet(ask_past=noting([]))
    second.on_alive("reactor/b/alive/plant", True, 0)
    said += second.on_past(Past("b", older, run[:360]), 0)
    second.rejoin("b", 0)
    said += second.on_past(Past("b", first.state_of("b"), run[:360]), 0)
    said += second.on_messages(run[360:], 0)
    assert [event for _, event, _ in alarms(said)] == ["raised", "cleared"]


def test_a_state_that_cannot_be_used_is_told_and_the_plant_learned_anew(runs: dict[str, list[Encoded]]) -> None:
    asked: list[tuple[str, bool]] = []
    monitor = fleet(ask_past=noting(asked), unusable=lambda plant, _: f"; {plant} is kept aside")
    monitor.on_alive("reactor/a/alive/plant", True, 0)
    assert (asked, monitor.plants) == ([("a", False)], [])
    monitor.on_past(Past("a", b"rubbish", runs["a"][:30]), 0)
    assert (monitor.plants, monitor.monitor("a").rows) == (["a"], 10)
    ((plant, line),) = monitor.reports(0)
    assert plant == "a"
    assert "learned anew; a is kept aside" in line


def test_what_is_told_of_a_plant_that_is_anothers_by_then_is_passed_over() -> None:
    at_home = home("a", 2)
    monitor = fleet(shard=Shard(3 - at_home, 2), name="us", ask_past=lambda _plant, _taken_over: True)
    monitor.on_alive(shard_token(at_home), True, 0)
    monitor.on_alive("reactor/a/alive/plant", True, 0)
    monitor.on_alive(shard_token(at_home), False, 0)
    monitor.on_alive(shard_token(at_home), True, 0)
    assert monitor.on_past(Past("a", None, []), 0) == []
    assert monitor.plants == []


def test_a_plant_that_is_given_back_is_stored(runs: dict[str, list[Encoded]]) -> None:
    at_home, stored = home("a", 2), dict[str, bytes]()
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


def first_sample(plant: str) -> Encoded:
    return run_of(plant, 1, span_min=0.5)[0]


def test_there_is_room_for_a_thousand_names_that_nobody_vouches_for_and_for_all_plants_with_a_token() -> None:
    monitor, sample = fleet(shard=Shard(3 - home("x", 2), 2)), first_sample("x")  # those of the other shard count, too
    for number in range(1500):
        monitor.on_message(sample._replace(key=f"reactor/made-up{number}/sample/T"), 0)
    assert 400 < len(monitor.plants) < 600
    before = set(monitor.plants)
    monitor.on_message(sample._replace(key="reactor/one-more/sample/T"), 0)
    ours = [plant for plant in (f"with-token{number}" for number in range(20)) if home(plant, 2) != home("x", 2)]
    for plant in ours:
        monitor.on_alive(f"reactor/{plant}/alive/plant", True, 0)
    assert set(monitor.plants) == before | set(ours)


def test_a_made_up_name_is_forgotten_when_nothing_more_is_said_of_it_and_makes_room() -> None:
    shown: list[tuple[str, bool]] = []
    monitor = fleet(in_charge=lambda plant, ours: shown.append((plant, ours)))
    monitor.on_message(first_sample("x"), 0)
    monitor.on_tick(TEN_MINUTES_NS - 1)
    assert (monitor.plants, monitor.forgotten) == (["x"], 0)
    monitor.on_tick(TEN_MINUTES_NS)
    assert (monitor.plants, monitor.forgotten) == ([], 1)
    assert shown == [("x", True), ("x", False)]
    monitor.on_message(first_sample("x"), TEN_MINUTES_NS)
    assert monitor.plants == ["x"]


def test_a_plant_with_a_token_with_a_state_or_with_rows_is_not_forgotten(runs: dict[str, list[Encoded]]) -> None:
    monitor = fleet(ask_past=lambda plant, _: plant == "c")
    monitor.on_message(first_sample("x"), 0)
    monitor.on_alive("reactor/x/alive/plant", True, 0)
    monitor.on_messages(runs["a"][: 3 * 32], 0)
    monitor.on_messages(runs["b"][: 3 * 31], 0)
    state = fleet()
    state.on_messages(runs["c"][:3], 0)
    monitor.on_message(runs["c"][0], 0)
    monitor.on_past(Past("c", state.state_of("c"), []), 0)
    monitor.on_tick(TEN_MINUTES_NS)
    assert sorted(monitor.plants) == ["a", "c", "x"]


@pytest.mark.parametrize(("messages", "known"), [(95, False), (96, True)])
def test_a_plant_of_another_shard_is_remembered_for_its_messages(
    messages: int, known: bool, runs: dict[str, list[Encoded]]
) -> None:
    asked: list[tuple[str, bool]] = []
    at_home = home("a", 2)
    monitor = fleet(shard=Shard(3 - at_home, 2), ask_past=noting(asked))
    monitor.on_alive(shard_token(at_home), True, 0)
    for message in runs["a"][:messages]:
        monitor.on_message(message, 0)
    monitor.on_tick(TEN_MINUTES_NS)
    monitor.on_alive(shard_token(at_home), False, TEN_MINUTES_NS)
    assert asked == [("a", True)] * known


def test_a_name_of_which_nothing_is_known_is_not_stored(runs: dict[str, list[Encoded]]) -> None:
    monitor = fleet()
    monitor.on_messages(runs["a"][: 3 * 31], 0)
    monitor.on_alive("reactor/b/alive/plant", True, 0)
    assert [monitor.is_worth_storing(plant) for plant in ("a", "b")] == [False, False]
    monitor.on_messages(runs["a"][3 * 31 : 3 * 32] + runs["b"][:6], 0)
    assert [monitor.is_worth_storing(plant) for plant in ("a", "b")] == [True, True]


# --- cut off from the others -------------------------------------------------------------------------------------


def places_of(run: list[Encoded], time_ns: int) -> int:
    """Where in a run the row of a time begins."""
    return next(place for place, item in enumerate(run) if Sample.FromString(item.payload).time_ns == time_ns)


@pytest.mark.parametrize("heard_the_other", [False, True])
def test_who_was_cut_off_tells_no_alarm_again_that_another_has_told_and_loses_none(
    heard_the_other: bool, runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    """The leak sets in while the first is cut off; the second tells the alarms, but for the last."""
    run, at_home = runs["b"], home("b", 2)
    told = [time_ns for _, _, time_ns in alarms(expected["b"])]
    cut_at, back_at = places_of(run, told[0]) - 30, places_of(run, told[-1]) - 3
    first, second = fleet(shard=Shard(at_home, 2), name="first", ask_past=noting([])), fleet()
    first.on_alive("reactor/b/alive/plant", True, 0)
    said = first.on_past(Past("b", None, run[:cut_at]), 0)
    second.adopt("b", first.state_of("b"), 0)
    first.hold()
    others = second.on_messages(run[cut_at:back_at], 0)
    said += others
    assert (first.on_messages(run[cut_at:back_at], 0), first.on_tick(100 * SECOND_NS)) == ([], [])
    if heard_the_other:
        first.on_messages([encode(item) for item in others], 0)
    assert first.go_on(["b"], 0) == []
    assert first.plants == []
    first.on_messages(run[back_at : back_at + 6], 0)
    said += first.on_past(Past("b", second.state_of("b"), run[: back_at + 6]), 0)
    said += first.on_messages(run[back_at + 6 :], 0)
    assert 1 < len(alarms(others)) < len(told)
    assert alarms(of("b", said)) == alarms(expected["b"])
    assert first.monitor("b").rows == len(run) // 3


def test_with_the_state_that_he_stored_himself_who_was_cut_off_tells_nothing_again_that_he_said_after_it(
    runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    run, raised_ns = runs["b"], alarms(expected["b"])[0][2]
    stored_at, cut_at = places_of(run, raised_ns) - 60, places_of(run, raised_ns) + 60
    monitor = fleet(ask_past=noting([]))
    monitor.on_alive("reactor/b/alive/plant", True, 0)
    said = monitor.on_past(Past("b", None, run[:stored_at]), 0)
    state = monitor.state_of("b")
    said += monitor.on_messages(run[stored_at:cut_at], 0)
    monitor.rejoin("b", 0)
    said += monitor.on_past(Past("b", state, run[: cut_at + 30]), 0)
    said += monitor.on_messages(run[cut_at + 30 :], 0)
    assert alarms(of("b", said)) == alarms(expected["b"])


def test_of_plants_that_nobody_else_has_watched_what_came_meanwhile_is_judged_as_if_it_had_come_now(
    runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    monitor, messages = fleet(), row_by_row(runs.values())
    said = monitor.on_messages(messages[:2000], 0)
    monitor.hold()
    for place in range(2000, len(messages), 100):
        assert monitor.on_messages(messages[place : place + 100], 0) == []
    said += monitor.go_on((), 0)
    for plant in runs:
        assert of(plant, said) == expected[plant]


def test_a_silence_that_who_was_cut_off_has_raised_is_over_with_the_next_sample(runs: dict[str, list[Encoded]]) -> None:
    """To him the plant was silent; the other, from whose state he goes on, has heard it all the time."""
    run, monitor = runs["a"], fleet(ask_past=noting([]))
    monitor.on_alive("reactor/a/alive/plant", True, 0)
    monitor.on_past(Past("a", None, []), 0)
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
    said += monitor.on_past(Past("a", other.state_of("a"), run[:600]), now_ns)
    said += monitor.on_messages(run[600:603], now_ns)
    (raised, cleared) = [item.message for item in said if isinstance(item.message, Alarm)]
    assert (raised.event, cleared.event, cleared.raised_ns) == ("raised", "cleared", raised.raised_ns)


def test_what_is_too_large_takes_no_room_while_it_is_held_and_is_refused_afterwards(
    runs: dict[str, list[Encoded]],
) -> None:
    monitor = fleet()
    monitor.on_messages(runs["a"][:30], 0)
    monitor.hold()
    tracemalloc.start()
    try:
        for _ in range(100):
            monitor.on_message(runs["a"][0]._replace(payload=bytes(1_000_000)), 0)
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    monitor.go_on((), 0)
    assert held < 1_000_000
    assert monitor.monitor("a").refusals.by_reason == {"too_large": 100}


def test_more_than_can_be_held_is_judged_rather_than_lost(
    runs: dict[str, list[Encoded]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("monitor_node.fleet.monitor.MOST_HELD", 60)
    monitor = fleet()
    monitor.hold()
    for message in runs["a"][:59]:
        monitor.on_message(message, 0)
    assert monitor.plants == []
    monitor.on_message(runs["a"][59], 0)
    assert (monitor.holds, monitor.monitor("a").rows) == (False, 20)
