"""Made-up names of plants cost a fleet little, and are forgotten."""

import pytest

from monitor_node.fleet.sharding import Shard, home_shard
from monitor_node.ingest.pending import PlantHistory
from reactorwatch.contract.codec import Encoded

from ..fleets import SECOND_NS, fleet, noting, run_of, shard_token

TEN_MINUTES_NS = 600 * SECOND_NS


def first_sample(plant: str) -> Encoded:
    return run_of(plant, 1, span_min=0.5)[0]


def test_there_is_room_for_a_thousand_names_that_nobody_vouches_for_and_for_all_plants_with_a_token() -> None:
    monitor, sample = (
        fleet(shard=Shard(3 - home_shard("x", 2), 2)),
        first_sample("x"),
    )  # those of the other shard count, too
    for number in range(1500):
        monitor.on_message(sample._replace(key=f"reactor/made-up{number}/sample/T"), 0)
    assert 400 < len(monitor.plants) < 600
    before = set(monitor.plants)
    monitor.on_message(sample._replace(key="reactor/one-more/sample/T"), 0)
    ours = [
        plant for plant in (f"with-token{number}" for number in range(20)) if home_shard(plant, 2) != home_shard("x", 2)
    ]
    for plant in ours:
        monitor.on_alive(f"reactor/{plant}/alive/plant", True, 0)
    assert set(monitor.plants) == before | set(ours)


def test_a_made_up_name_is_forgotten_when_nothing_more_is_said_of_it_and_makes_room() -> None:
    shown: list[tuple[str, bool]] = []
    monitor = fleet(on_ownership=lambda plant, ours: shown.append((plant, ours)))
    monitor.on_message(first_sample("x"), 0)
    monitor.on_tick(TEN_MINUTES_NS - 1)
    assert (monitor.plants, monitor.evictions) == (["x"], 0)
    monitor.on_tick(TEN_MINUTES_NS)
    assert (monitor.plants, monitor.evictions) == ([], 1)
    assert shown == [("x", True), ("x", False)]
    monitor.on_message(first_sample("x"), TEN_MINUTES_NS)
    assert monitor.plants == ["x"]


def test_a_plant_with_a_token_with_a_state_or_with_rows_is_not_forgotten(runs: dict[str, list[Encoded]]) -> None:
    monitor = fleet(request_history=lambda plant, _: plant == "c")
    monitor.on_message(first_sample("x"), 0)
    monitor.on_alive("reactor/x/alive/plant", True, 0)
    monitor.on_messages(runs["a"][: 3 * 32], 0)
    monitor.on_messages(runs["b"][: 3 * 31], 0)
    state = fleet()
    state.on_messages(runs["c"][:3], 0)
    monitor.on_message(runs["c"][0], 0)
    monitor.on_history(PlantHistory("c", state.state_of("c"), []), 0)
    monitor.on_tick(TEN_MINUTES_NS)
    assert sorted(monitor.plants) == ["a", "c", "x"]


@pytest.mark.parametrize(("messages", "known"), [(95, False), (96, True)])
def test_a_plant_of_another_shard_is_remembered_for_its_messages(
    messages: int, known: bool, runs: dict[str, list[Encoded]]
) -> None:
    asked: list[tuple[str, bool]] = []
    at_home = home_shard("a", 2)
    monitor = fleet(shard=Shard(3 - at_home, 2), request_history=noting(asked))
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
