"""Which monitor watches which plant."""

import pytest

from monitor_node.fleet.sharding import Shard, ShardGroup, home_shard, owner, parse_shard
from reactorwatch.errors import InputError

NAMES = [f"plant_{number}" for number in range(3000)]
FIVE = range(1, 6)


def test_a_shard_is_read_as_it_is_written() -> None:
    assert str(parse_shard("2/5")) == "2/5"


@pytest.mark.parametrize("text", ["0/5", "6/5", "2", "a/b", "1/0", "-1/5", "1/1001"])
def test_what_is_no_shard_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="shard must be like 2/5"):
        parse_shard(text)


def test_the_home_of_a_plant_is_the_same_everywhere_and_for_ever() -> None:
    assert home_shard("cstr", 1000) == 0xE3652AA51CECECB2 % 1000 + 1  # printf cstr | b2sum -l 64


def test_plants_spread_evenly_over_shards() -> None:
    counts = [sum(home_shard(name, 5) == number for name in NAMES) for number in FIVE]
    assert sum(counts) == 3000
    assert max(abs(count - 600) for count in counts) < 5 * (3000 * 0.2 * 0.8) ** 0.5  # five standard deviations


def test_the_plants_of_a_dead_shard_spread_over_the_living_and_no_other_moves() -> None:
    living = {1, 2, 4, 5}
    moved = [name for name in NAMES if owner(name, 5, living) != home_shard(name, 5)]
    assert all(home_shard(name, 5) == 3 for name in moved)
    shares = [sum(owner(name, 5, living) == number for name in moved) for number in living]
    assert min(shares) > len(moved) / 4 - 5 * (len(moved) * 0.25 * 0.75) ** 0.5


def test_without_anybody_nobody_keeps_a_plant() -> None:
    assert owner("x", 5, set()) is None


def groups(*shards: Shard) -> list[ShardGroup]:
    """Monitors that all have seen each other, each named by its place."""
    found = [ShardGroup("reactor/*", shard, f"{place:02}") for place, shard in enumerate(shards)]
    for each in found:
        for other in found:
            each.on_token(other.token, is_alive=True)
        each.drop_unseen()
    return found


def owners(found: list[ShardGroup], name: str) -> int:
    return sum(each.is_ours(name) for each in found)


def test_every_plant_is_watched_by_one_monitor_whoever_lives() -> None:
    found = groups(*(Shard(number, 5) for number in FIVE))
    for dead in (2, 0, 3):
        assert all(owners(found, name) == 1 for name in NAMES[:300])
        gone = found.pop(min(dead, len(found) - 1))
        for each in found:
            each.on_token(gone.token, is_alive=False)
    assert all(owners(found, name) == 1 for name in NAMES[:300])


def test_of_two_with_the_same_shard_the_second_stands_by_until_the_first_is_gone() -> None:
    first, second = groups(Shard(1, 1), Shard(1, 1))
    assert (first.is_ours("x"), second.is_ours("x")) == (True, False)
    second.on_token(first.token, is_alive=False)
    assert second.is_ours("x")


def test_a_shard_that_was_never_seen_is_left_alone_until_it_is_presumed_gone() -> None:
    shards = ShardGroup("reactor/*", Shard(1, 2), "a")
    theirs = next(name for name in NAMES if home_shard(name, 2) == 2)
    assert not shards.is_ours(theirs)
    assert shards.drop_unseen()
    assert shards.is_ours(theirs)


def test_monitors_of_another_fleet_are_none_of_ours() -> None:
    shards = ShardGroup("reactor/*", Shard(1, 2), "a")
    assert not shards.on_token(ShardGroup("reactor/north_*", Shard(2, 2), "b").token, is_alive=True)
    assert not shards.on_token(ShardGroup("reactor/*", Shard(2, 3), "c").token, is_alive=True)
    assert not shards.on_token("reactor/cstr/alive/plant", is_alive=True)


def test_our_own_token_that_vanishes_makes_nobody_else_of_us() -> None:
    shards = ShardGroup("reactor/*", Shard(1, 1), "a")
    shards.on_token(shards.token, is_alive=False)
    assert shards.is_ours("x")
