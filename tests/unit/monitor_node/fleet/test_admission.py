"""Invented names of plants cost a fleet little, and are evicted."""

from monitor_node.fleet import Shard, shard_of
from reactorwatch.contract.codec import Encoded

from ..fleets import SECOND_NS, fleet, run_of

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
