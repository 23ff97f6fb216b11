"""Points become alarms by a rule whose false-alarm rate is known.

The figures of EEMUA 191, against cases counted by hand.
"""

import numpy as np
import pytest

from monitor_node.alarms.alarms import ChartAlarm, is_empty
from reactorwatch.contract.alarm_states import Event
from reactorwatch.contract.messages_pb2 import AlarmKpis, Priority, PriorityCount
from reactorwatch.records.record import to_time_ns
from reactorwatch.spc.charts.base import Judgement
from reactorwatch.spc.charts.shewhart import probability_out
from reactorwatch.spc.run_length import false_alarm_rate

from .desk import Desk

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


IN, OUT = 0.0, 5.0


def raise_at(desk: Desk, *minutes: float, signal: str = "T") -> None:
    """Raise an alarm at these times, and clear it a hundredth of a minute later."""
    for minute in minutes:
        desk.point(minute, **{signal: OUT})
        desk.point(minute + 0.01, **{signal: IN})


def test_alarms_of_the_last_ten_minutes_are_counted_and_older_ones_are_not() -> None:
    desk = Desk()
    raise_at(desk, 0, 3, 6, 9.5)
    assert desk.figures().alarms_10min == 4
    desk.point(10.0)  # the first came up exactly ten minutes ago
    assert desk.figures().alarms_10min == 3
    desk.point(16.5)
    assert desk.figures().alarms_10min == 1
    desk.point(30.0)
    assert desk.figures().alarms_10min == 0


def test_ten_alarms_in_ten_minutes_are_no_flood_and_eleven_are() -> None:
    desk = Desk()
    raise_at(desk, *(0.9 * k for k in range(10)))
    assert (desk.figures().alarms_10min, desk.figures().flood) == (10, False)
    raise_at(desk, 9.0)
    assert (desk.figures().alarms_10min, desk.figures().flood) == (11, True)
    desk.point(11.0)  # those at 0 and 0.9 are gone
    assert (desk.figures().alarms_10min, desk.figures().flood) == (9, False)


def test_three_times_within_one_minute_chatters_and_in_more_does_not() -> None:
    desk = Desk()
    raise_at(desk, 0.0, 0.5, 1.1, signal="C")
    raise_at(desk, 2.0, 2.5, 3.0)
    assert list(desk.figures().chattering) == ["shewhart/T"]
    raise_at(desk, 3.2, 3.4, 3.6, signal="C")
    assert list(desk.figures().chattering) == ["shewhart/C", "shewhart/T"]
    desk.point(12.2)  # of T only the third is left
    assert list(desk.figures().chattering) == ["shewhart/C"]


def test_an_alarm_that_stands_for_more_than_a_day_is_stale() -> None:
    desk = Desk()
    desk.point(0, T=OUT, C=OUT)
    desk.point(1, C=IN)
    desk.point(24 * 60, T=OUT)
    assert (list(desk.figures().standing), list(desk.figures().stale)) == (["shewhart/T"], [])
    desk.point(24 * 60 + 1, T=OUT)
    assert list(desk.figures().stale) == ["shewhart/T"]


def test_priorities_and_states_are_counted() -> None:
    desk = Desk()  # T is of high priority, C of medium
    raise_at(desk, 0, 1)
    desk.point(2, T=OUT, C=OUT)
    assert desk.figures().unacknowledged == 2
    desk.published += desk.board.act("shewhart/C", Event.SHELVE, "Anna", "", 5.0)
    figures = desk.figures()
    counts = {Priority.Name(item.priority): (item.raised, item.standing) for item in figures.priorities}
    assert counts == {
        "PRIORITY_CRITICAL": (0, 0),
        "PRIORITY_HIGH": (3, 1),
        "PRIORITY_MEDIUM": (1, 0),
        "PRIORITY_LOW": (0, 0),
    }
    assert (figures.unacknowledged, figures.shelved, figures.suppressed, figures.out_of_service) == (1, 1, 0, 0)
    assert figures.incidents == 1
    assert list(counts) == [f"PRIORITY_{name}" for name in ("CRITICAL", "HIGH", "MEDIUM", "LOW")]


def test_they_are_published_at_each_minute_and_at_each_change() -> None:
    desk = Desk()
    for row in range(30):
        desk.point(row / 10, T=OUT if row == 14 else IN)
    times = [item.time_ns for item in desk.messages(AlarmKpis)]
    assert times == [to_time_ns(minute) for minute in (0, 1, 1.4, 1.5, 2)]


def test_a_clock_that_is_set_back_forgets_what_lies_ahead() -> None:
    desk = Desk()
    raise_at(desk, 100)
    desk.point(50)
    assert desk.figures().alarms_10min == 0


def test_figures_are_empty_until_an_alarm_is_activated_or_hidden() -> None:
    desk = Desk()
    desk.point(0)
    assert is_empty(desk.figures())
    desk.published += desk.board.act("shewhart/C", Event.SUPPRESS, "Anna", "")
    assert not is_empty(desk.figures())
    desk.published += desk.board.act("shewhart/C", Event.UNSUPPRESS, "Anna", "")
    assert is_empty(desk.figures())
    raise_at(desk, 1)
    assert not is_empty(desk.figures())
    assert not is_empty(AlarmKpis(priorities=[PriorityCount(raised=0), PriorityCount(raised=1)]))
    assert is_empty(AlarmKpis(time_ns=7, priorities=[PriorityCount(raised=0)]))
