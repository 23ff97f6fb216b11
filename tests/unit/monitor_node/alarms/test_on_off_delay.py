"""Points become alarms by a rule whose false-alarm rate is known."""

import numpy as np
import pytest

from monitor_node.alarms.alarms import ChartAlarm
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.charts.shewhart import probability_out
from reactorwatch.spc.run_length import false_alarm_rate

POINTS = {False: Judgement(0.0, 0.0, -3.0, 3.0, False), True: Judgement(5.0, 0.0, -3.0, 3.0, True)}


def alarm(raise_count: int, window: int, clear_count: int) -> ChartAlarm:
    return ChartAlarm("shewhart", "T", "medium", (raise_count, window, clear_count), 0.1)


def changes(rule: ChartAlarm, points: str) -> list[tuple[int, bool]]:
    """Points as text, x for out; returns (position, raised or cleared)."""
    found = [(position, rule.update(POINTS[point == "x"])) for position, point in enumerate(points)]
    return [(position, change.is_raised) for position, change in found if change is not None]


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ("xx..x", [(4, True)]),
        ("xx...x", []),
        ("xxx", [(2, True)]),
        ("xxxx", [(2, True)]),
        ("xxx...", [(2, True), (5, False)]),
        ("xxx..x...", [(2, True), (8, False)]),
        ("xxx...xx.x", [(2, True), (5, False), (9, True)]),
    ],
)
def test_three_of_five_raise_and_three_in_a_row_clear(points: str, expected: list[tuple[int, bool]]) -> None:
    assert changes(alarm(3, 5, 3), points) == expected


@pytest.mark.parametrize(
    ("rule", "width", "run_length"),
    [
        ((1, 1), 3.0, 370.40),  # Champ & Woodall (1987), table 1: rule 1
        ((1, 1), 2.0, 21.978),
    ],
)
def test_one_of_one_is_the_shewhart_chart(rule: tuple[int, int], width: float, run_length: float) -> None:
    assert 1 / false_alarm_rate(*rule, probability_out(width)) == pytest.approx(run_length, rel=1e-4)


def test_k_in_a_row_has_the_run_length_of_success_runs() -> None:
    """Feller (1968), An Introduction to Probability Theory, vol. 1, XIII.7: (1 - p^k) / (q p^k)."""
    p = 0.05
    for k in (2, 3, 4):
        assert 1 / false_alarm_rate(k, k, p) == pytest.approx((1 - p**k) / ((1 - p) * p**k), rel=1e-9)


def test_the_rate_is_what_simulation_finds() -> None:
    p, generator = 0.08, np.random.default_rng(5)
    lengths = []
    for _ in range(2000):
        rule, length = alarm(3, 5, 1), 1
        while rule.update(POINTS[bool(generator.random() < p)]) is None:
            length += 1
        lengths.append(length)
    mean, error = np.mean(lengths), np.std(lengths) / np.sqrt(len(lengths))
    assert abs(mean - 1 / false_alarm_rate(3, 5, p)) < 4 * error


@pytest.mark.parametrize("rule", [(0, 5, 1), (6, 5, 1), (3, 13, 1), (3, 5, 0)])
def test_numbers_that_make_no_rule_are_refused(rule: tuple[int, int, int]) -> None:
    with pytest.raises(ValueError, match="must be"):
        alarm(*rule)
