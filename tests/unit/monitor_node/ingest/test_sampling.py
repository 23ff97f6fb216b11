"""The sampling period is learned from the first rows; a row follows, or rows are missing before it."""

import numpy as np
import pytest

from monitor_node.ingest.rows import LEARN_FROM, SamplingPeriod, missing_in_intervals, regular_intervals

PERIOD_NS = 6_000_000_000


def learned() -> SamplingPeriod:
    """A period that was learned from even rows; the last is at time 0."""
    sampling = SamplingPeriod()
    for row in range(-LEARN_FROM, 1):
        sampling.update(row * PERIOD_NS)
    return sampling


@pytest.mark.parametrize(
    ("periods", "follows", "is_gap", "missing"),
    [
        (1.0, True, False, 0),
        (1.09, True, False, 0),
        (1.1, True, False, 0),
        (0.9, True, False, 0),
        (1.11, False, False, 0),
        (0.2, False, False, 0),
        (1.75, False, False, 1),
        (2.0, False, False, 1),
        (2.25, False, False, 1),
        (2.26, False, False, 0),  # no whole number of periods
        (2.5, False, False, 0),
        (2.51, False, True, 0),
        (3.1, False, True, 2),
        (-1.0, False, True, 0),
        (0.0, False, True, 0),
    ],
)
def test_an_interval_follows_or_is_a_gap_by_its_length(
    periods: float, follows: bool, is_gap: bool, missing: int
) -> None:
    assert learned().update(round(periods * PERIOD_NS)) == (follows, is_gap, missing)


def test_the_first_row_follows_nothing_and_the_next_ones_the_shortest_interval_so_far() -> None:
    sampling = SamplingPeriod()
    assert sampling.period_ns == 0.0
    intervals = [sampling.update(time_ns) for time_ns in (0, 100, 200, 340, 490, 650, 950)]
    assert [item.follows for item in intervals] == [False, True, True, True, True, False, False]
    assert [item.is_gap for item in intervals] == [False, False, False, False, False, False, True]
    assert [item.missing for item in intervals] == [0] * 7
    assert sampling.period_ns == 100.0


def test_the_period_is_the_median_of_the_first_32_intervals() -> None:
    sampling, time_ns = SamplingPeriod(), 0
    sampling.update(time_ns)
    for number in range(40):
        time_ns += 100 + number
        sampling.update(time_ns)
        assert sampling.learned_ns == (None if number < 31 else 115.5)


def test_a_record_has_the_same_regular_and_missing_intervals_as_its_rows_one_by_one() -> None:
    """With the median of the record, which here is the one of the first rows."""
    steps = np.random.default_rng(1).choice([*[1.0] * 8, 1.05, 1.3, 2.0, 3.0, 6.6], 400)
    time_min = np.concatenate([np.arange(LEARN_FROM + 1), LEARN_FROM + np.cumsum(steps)]) * 0.1
    sampling = SamplingPeriod()
    intervals = [sampling.update(round(minutes * 6e10)) for minutes in time_min.tolist()][1:]
    behind = slice(LEARN_FROM, None)
    assert regular_intervals(time_min).tolist()[behind] == [item.follows for item in intervals][behind]
    assert missing_in_intervals(time_min).tolist()[behind] == [item.missing for item in intervals][behind]
