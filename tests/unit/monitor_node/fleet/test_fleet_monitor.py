"""Monitoring of a fleet: each plant is monitored as if it were alone, by one monitor."""

import pytest

from monitor_node.config import MonitorConfig
from monitor_node.fleet import Shard, shard_of
from reactorwatch.contract.codec import Encoded, Publication, encode_message
from reactorwatch.contract.messages_pb2 import Alarm, AlarmCommand, CommandReply, Health
from reactorwatch.errors import InputError

from ..fleets import QUICK, SECOND_NS, fleet, of, row_by_row


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
