"""The soak's rule for memory: level after the warm-up, of a process that ran all the time since."""

import pytest

from benchmarks.soak.findings import GROWTH_MB, Taken, find_growth_mb, most_in_thirds
from benchmarks.soak.plan import draw_plan

ROWS = 300


def taken(*memory_mb: float, pids: tuple[int, ...] = (1,)) -> list[Taken]:
    """Measurements at equal distances over the run; `pids` are the processes one after the other."""
    count = len(memory_mb)
    return [
        Taken(ROWS * number // count, pids[len(pids) * number // count], value)
        for number, value in enumerate(memory_mb)
    ]


@pytest.mark.parametrize(
    ("memory_mb", "is_level"),
    [
        ([50.0, 80.0, 100.0, *[100.0] * 6], True),
        ([100.0, 100.0, 100.0, 100.0, 100.0, 100.0, 160.0, 100.0, 100.0], True),
        ([100.0 + 4.0 * number for number in range(9)], False),
        ([100.0] * 6 + [120.0] * 3, False),
    ],
    ids=["warm-up", "a flood", "a steady leak", "a step"],
)
def test_memory_is_level_if_the_median_does_not_grow_after_the_warm_up(memory_mb: list[float], is_level: bool) -> None:
    growth_mb = find_growth_mb(taken(*memory_mb), ROWS)
    assert growth_mb is not None
    assert (growth_mb <= GROWTH_MB) == is_level


def test_no_growth_is_reported_of_a_process_that_was_restarted_after_the_warm_up() -> None:
    assert find_growth_mb(taken(*[100.0] * 9, pids=(1, 2, 2)), ROWS) == 0.0
    assert find_growth_mb(taken(*[100.0] * 9, pids=(1, 1, 2)), ROWS) is None
    assert find_growth_mb(taken(*[100.0] * 9)[:6], ROWS) is None


def test_the_most_is_of_each_third() -> None:
    assert most_in_thirds(taken(1.0, 9.0, 2.0, 3.0, 5.0, 4.0), ROWS) == (9.0, 3.0, 5.0)


def test_the_first_monitor_is_never_killed() -> None:
    killed = [blow for seed in range(20) for blow in draw_plan(seed, 4, 3600, 2.0).blows if blow.kind == "kill monitor"]
    assert len(killed) > 20
    assert {blow.monitor for blow in killed} == {1}
