"""The figures of EEMUA 191, against cases counted by hand."""

from monitor_node.alarms.alarms import is_empty
from reactorwatch.contract.alarm_states import Event
from reactorwatch.contract.messages_pb2 import AlarmKpis, Priority, PriorityCount
from reactorwatch.records.record import to_time_ns

from .desk import Desk

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
