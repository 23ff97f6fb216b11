"""Monitoring of a fleet: each plant is monitored as if it were alone, by one monitor.

Invented names of plants cost a fleet little, and are evicted.
A fleet's false alarms a day are promised for all of its plants together, beside each plant's own number.
"""

import pytest
from structlog.testing import capture_logs

from monitor_node.config import MonitorConfig
from monitor_node.fleet import FleetConfig, Shard, shard_of
from monitor_node.node import MonitorNode
from reactorwatch.contract.codec import Encoded, Publication, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, AlarmCommand, CommandReply, Health
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import section

from ..fleets import QUICK, SECOND_NS, fleet, of, row_by_row, run_of


def test_a_batch_of_messages_gives_the_output_of_each_alone(
    runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    monitor, messages, said = fleet(), row_by_row(runs.values()), list[Publication]()
    for begin in range(0, len(messages), 700):
        said += monitor.on_messages(messages[begin : begin + 700], 0)
    for plant in runs:
        assert of(plant, said) == expected[plant]


def test_a_plant_is_watched_as_soon_as_a_node_of_it_is_alive() -> None:
    shown: list[tuple[str, bool]] = []
    monitor = fleet(on_watch=lambda plant, ours: shown.append((plant, ours)))
    monitor.on_alive("reactor/fleet/alive/recorder", True, 0)  # of all plants
    assert not monitor.plants
    monitor.on_alive("reactor/x/alive/plant", True, 0)
    assert monitor.plants == ["x"]
    assert shown == [("x", True)]


def test_a_plant_whose_node_stops_is_still_monitored() -> None:
    monitor = fleet()
    monitor.on_alive("reactor/x/alive/plant", True, 0)
    monitor.on_alive("reactor/x/alive/plant", False, 1)
    assert monitor.plants == ["x"]


@pytest.mark.parametrize("key", ["weather/x/sample/T", "reactor/x/health/plant", "reactor/@fleet/sample/T"])
def test_what_is_no_sample_of_a_plant_makes_no_plant(key: str) -> None:
    monitor = fleet()
    assert monitor.on_message(Encoded(key, b"", ""), 0) == []
    assert monitor.plants == []


def test_the_health_of_each_plants_monitor_is_published() -> None:
    monitor = fleet()
    for plant in ("x", "y"):
        monitor.on_alive(f"reactor/{plant}/alive/plant", True, 0)
    told = [item.key for item in monitor.on_tick(SECOND_NS) if isinstance(item.message, Health)]
    assert sorted(told) == ["reactor/x/health/monitor", "reactor/y/health/monitor"]
    assert monitor.next_tick_ns() == SECOND_NS + int(QUICK.health_period_s * 1e9)


def test_a_plant_that_falls_silent_is_reported_while_others_continue(runs: dict[str, list[Encoded]]) -> None:
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


def test_a_command_is_executed_by_the_monitor_of_its_plant_alone(runs: dict[str, list[Encoded]]) -> None:
    monitor = fleet(shard=Shard(shard_of("a", 2), 2))
    payload, encoding = encode_message(AlarmCommand(alarm="ewma/T", by="Ada", comment="seen"))
    monitor.on_messages(runs["a"][:3] + runs["a"][3:6], 0)
    reply, _ = monitor.on_command(Encoded("reactor/a/command/comment", payload, encoding), 0)
    assert isinstance(reply, CommandReply)
    assert reply.accepted
    theirs = next(name for name in map(str, range(99)) if shard_of(name, 2) != shard_of("a", 2))
    assert monitor.on_command(Encoded(f"reactor/{theirs}/command/comment", payload, encoding), 0) == (None, [])


def test_settings_that_make_no_monitor_are_refused_before_there_is_a_plant() -> None:
    with pytest.raises(InputError, match="reference"):
        fleet(config=MonitorConfig(outputs=("pressure",), priorities={}, reference="process"))


def test_shards_together_publish_of_each_plant_what_one_monitor_publishes_once(
    runs: dict[str, list[Encoded]], expected: dict[str, list[Publication]]
) -> None:
    monitors = [fleet(shard=Shard(number, 3)) for number in (1, 2, 3)]
    said = [item for message in row_by_row(runs.values()) for each in monitors for item in each.on_message(message, 0)]
    assert sorted(plant for each in monitors for plant in each.plants) == ["a", "b", "c"]
    for plant in runs:
        assert of(plant, said) == expected[plant]


@pytest.mark.parametrize("of", [2, 5, 100])
def test_each_plant_is_in_one_shard_and_shards_are_about_equal(of: int) -> None:
    plants = [f"plant{number}" for number in range(100 * of)]
    counts = [sum(Shard(number, of).has(plant) for plant in plants) for number in range(1, of + 1)]
    assert sum(counts) == len(plants)
    assert 60 < min(counts) <= max(counts) < 140  # four standard deviations of 10


TEN_MINUTES_NS = 600 * SECOND_NS


def first_sample(plant: str) -> Encoded:
    return run_of(plant, 1, span_min=0.5)[0]


def test_there_is_room_for_a_thousand_unverified_names_and_for_all_plants_with_a_token() -> None:
    monitor, sample = fleet(shard=Shard(shard_of("x", 2), 2)), first_sample("x")
    for number in range(2500):
        monitor.on_message(sample._replace(key=f"reactor/made-up{number}/sample/T"), 0)
    before = set(monitor.plants)
    assert len(before) == 1000
    assert {shard_of(plant, 2) for plant in before} == {shard_of("x", 2)}
    monitor.on_message(sample._replace(key="reactor/x/sample/T"), 0)
    ours = [
        plant for plant in (f"with-token{number}" for number in range(20)) if shard_of(plant, 2) == shard_of("x", 2)
    ]
    for plant in ours:
        monitor.on_alive(f"reactor/{plant}/alive/plant", True, 0)
    assert set(monitor.plants) == before | set(ours)


def test_an_unverified_name_without_messages_is_evicted_and_makes_room() -> None:
    shown: list[tuple[str, bool]] = []
    monitor = fleet(on_watch=lambda plant, watched: shown.append((plant, watched)))
    monitor.on_message(first_sample("x"), 0)
    monitor.on_tick(TEN_MINUTES_NS - 1)
    assert (monitor.plants, monitor.evictions) == (["x"], 0)
    monitor.on_tick(TEN_MINUTES_NS)
    assert (monitor.plants, monitor.evictions) == ([], 1)
    assert shown == [("x", True), ("x", False)]
    monitor.on_tick(2 * TEN_MINUTES_NS)  # its deadlines have gone with it
    monitor.on_message(first_sample("x"), 2 * TEN_MINUTES_NS)
    assert monitor.plants == ["x"]


def test_a_plant_with_a_token_with_a_state_or_with_rows_is_not_evicted(runs: dict[str, list[Encoded]]) -> None:
    monitor, before = fleet(), fleet()
    monitor.on_message(first_sample("x"), 0)
    monitor.on_alive("reactor/x/alive/plant", True, 0)
    monitor.on_messages(runs["a"][: 3 * 32], 0)
    monitor.on_messages(runs["b"][: 3 * 31], 0)
    before.on_messages(runs["c"][:3], 0)
    state = before.monitor("c").to_bytes()
    monitor.register("c", 0, verified=True, restore=lambda own: own.from_bytes(state))
    monitor.on_tick(TEN_MINUTES_NS)
    assert sorted(monitor.plants) == ["a", "c", "x"]


def test_an_unverified_name_is_not_stored(runs: dict[str, list[Encoded]]) -> None:
    monitor = fleet()
    monitor.on_messages(runs["a"][: 3 * 31], 0)
    monitor.on_alive("reactor/b/alive/plant", True, 0)
    assert [monitor.is_worth_storing(plant) for plant in ("a", "b")] == [False, False]
    monitor.on_messages(runs["a"][3 * 31 : 3 * 32] + runs["b"][:6], 0)
    assert [monitor.is_worth_storing(plant) for plant in ("a", "b")] == [True, True]


OWN = MonitorConfig(false_alarms_per_30_days=0.5)


@pytest.mark.parametrize("plants", [4, 100, 1000])
def test_the_shares_of_all_plants_sum_up_to_the_promise(plants: int) -> None:
    fleet = FleetConfig(plants="reactor/*", false_alarms_per_day=4.0, most_plants=plants)
    share = fleet.share_promise(MonitorConfig()).false_alarms_per_30_days
    assert share is not None
    assert plants * share / 30.0 == pytest.approx(4.0)


def test_of_a_plant_s_own_number_and_its_share_the_smaller_holds() -> None:
    few, many = (FleetConfig(plants="reactor/*", false_alarms_per_day=1.0, most_plants=count) for count in (10, 300))
    assert few.share_promise(OWN).false_alarms_per_30_days == 0.5
    assert many.share_promise(OWN).false_alarms_per_30_days == pytest.approx(0.1)


def test_without_a_promise_for_the_fleet_each_plant_has_its_own() -> None:
    fleet = FleetConfig(plants="reactor/*")
    assert (fleet.share_promise(OWN), fleet.share_promise(QUICK)) == (OWN, QUICK)


def test_a_plant_named_without_a_pattern_has_it_alone() -> None:
    assert FleetConfig(plants="reactor/north", false_alarms_per_day=1.0).share_per_30_days == 30.0


def test_a_share_that_no_plant_can_have_is_refused_in_one_line() -> None:
    with pytest.raises(InputError, match="false_alarms_per_day over most_plants must be in") as refused:
        section(FleetConfig, "fleet", {"fleet": {"plants": "reactor/*", "false_alarms_per_day": 1e-3}}, {})
    assert "\n" not in str(refused.value)


def test_each_plant_is_watched_with_its_share() -> None:
    fleet = FleetConfig(plants="reactor/*", false_alarms_per_day=2.0, most_plants=30)
    node = MonitorNode(QUICK, 0, fleet)
    for message in run_of("x", 11, span_min=25.0):
        node.on_messages([message], 0)
    promise = node.monitor("x").promise
    assert promise is not None
    assert promise.expected == pytest.approx(2.0)
    assert promise.expected * 30 / 30.0 == pytest.approx(2.0)  # thirty plants, a thirtieth of a month


def test_more_plants_than_share_it_are_logged_once_with_what_may_come() -> None:
    fleet = FleetConfig(plants="reactor/*", false_alarms_per_day=1.0, most_plants=2)
    node = MonitorNode(QUICK, 0, fleet)
    with capture_logs() as lines:
        for name in ("a", "b", "c"):
            node.register(name, 0, verified=True)
        for now_ns in (10**9, 10**12, 2 * 10**12):
            node.on_tick(now_ns)
    found = [line["event"] for line in lines if "false_alarms_per_day is divided among 2" in line["event"]]
    assert len(found) == 1
    assert "up to 1.5 false alarms a day" in found[0]
