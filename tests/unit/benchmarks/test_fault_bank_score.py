"""Detections, delays and rates are counted as the benchmark defines them."""

from math import inf

import pytest

from benchmarks.faults.score import Delays, Interval, Outcome, Rate, outcome_of, rows_to_false_alarm


@pytest.mark.parametrize(
    ("alarms", "delay_min", "false_alarms"),
    [
        ([], inf, 0),
        ([Interval(303.0, inf)], 3.0, 0),
        ([Interval(310.0, inf), Interval(303.0, 305.0)], 3.0, 0),
        ([Interval(150.0, 160.0), Interval(303.0, inf)], 3.0, 1),
        ([Interval(299.0, 302.0), Interval(301.0, 304.0), Interval(305.0, inf)], 5.0, 1),
        ([Interval(299.0, inf), Interval(301.0, inf)], inf, 1),
        ([Interval(303.0, 304.0), Interval(303.0, inf)], 3.0, 0),
        ([Interval(451.0, inf)], inf, 0),
    ],
    ids=[
        "silence",
        "one alarm",
        "the first of two",
        "after a false alarm that is over",
        "not while a false alarm stands",
        "never while a false alarm stands",
        "two at once",
        "too late",
    ],
)
def test_the_first_alarm_after_the_onset_that_none_stood_before_is_the_detection(
    alarms: list[Interval], delay_min: float, false_alarms: int
) -> None:
    outcome = outcome_of(alarms, watching_since_min=100.0, onset_min=300.0, until_min=450.0)
    assert outcome == Outcome(delay_min, false_alarms, watched_min=200.0)


def test_what_is_not_detected_counts_as_endless_in_the_quantiles() -> None:
    assert Delays.of([1.0, 3.0, inf, 2.0]) == Delays(detected=0.75, median_min=2.0, slow_min=inf)
    assert Delays.of([inf, inf, 1.0, inf]) == Delays(detected=0.25, median_min=inf, slow_min=inf)


@pytest.mark.parametrize(("count", "lower", "upper"), [(0, 0.0, 3.689), (3, 0.6187, 8.767), (10, 4.795, 18.39)])
def test_intervals_of_a_rate_are_the_published_ones_of_a_poisson_count(count: int, lower: float, upper: float) -> None:
    """Pearson & Hartley, Biometrika Tables for Statisticians I, table 40, two-sided 95 %."""
    rate = Rate(count, watched_min=30 * 24 * 60)
    assert rate.interval_per_30_days == pytest.approx((lower, upper), rel=1e-3)


def test_rates_of_several_runs_are_pooled() -> None:
    assert Rate.total([Rate(1, 43_200.0), Rate(3, 43_200.0)]).per_30_days == pytest.approx(2.0)


def test_one_false_alarm_in_30_days_is_one_in_432000_rows() -> None:
    assert rows_to_false_alarm(1.0) == pytest.approx(432_000)
    assert rows_to_false_alarm(30.0) == pytest.approx(14_400)
