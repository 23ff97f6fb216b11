"""A recorder that is killed under load; `make kills` does it fifty times."""

from pathlib import Path

import pytest

from benchmarks.losses import kill_often

RATE_PER_S = 1000
"""A machine that has much else to do cannot keep up with the five thousand of `make kills`."""


@pytest.mark.slow
def test_three_kills_lose_less_than_a_second_each_and_nothing_before_it(tmp_path: Path) -> None:
    found = kill_often(tmp_path, 3, RATE_PER_S, seed=2)
    assert [(killed.missing, killed.late) for killed in found] == [(0, 0)] * 3
    assert all(killed.messages > 0 for killed in found)
    assert max(killed.lost_s for killed in found) <= 1.0
