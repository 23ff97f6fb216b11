"""Segments of time that are kept for good."""

import itertools

from reactorwatch.contract import messages_pb2 as messages
from recorder.keep import MAX_MARGINS, AlarmInterval, BlackBox

N = 600


def raised(name: str = "ewma/T", event: str = "raised") -> messages.Alarm:
    return messages.Alarm(alarm=name, event=event)


def test_an_alarm_keeps_what_was_before_and_what_comes_after() -> None:
    box = BlackBox(N)
    assert box.on_message(raised(), 1000) is None
    assert box.pop_ended(1000 + N) is None
    assert box.next_due_ns == 1000 + N + 1
    assert box.pop_ended(1000 + N + 1) == AlarmInterval(400, 1600, 1000, "ewma/T")
    assert box.pop_ended(10_000) is None


def test_alarms_that_come_before_it_is_over_share_a_stretch() -> None:
    box = BlackBox(N)
    box.on_message(raised("ewma/T"), 1000)
    box.on_message(raised("shewhart/C"), 1500)
    assert box.pop_ended(1601) is None
    assert box.pop_ended(2101) == AlarmInterval(400, 2100, 1000, "ewma/T")


def test_alarms_without_an_end_do_not_make_a_stretch_without_an_end() -> None:
    box, kept = BlackBox(N), []
    for at in range(1000, 1000 + 3 * MAX_MARGINS * N, N // 2):
        over = box.on_message(raised(), at)
        if over is not None:
            kept.append(over)
    assert len(kept) >= 2
    assert all(stretch.to_ns - stretch.raised_ns <= MAX_MARGINS * N for stretch in kept)
    assert max(stretch.to_ns - stretch.from_ns for stretch in kept) == box.longest_ns
    for before, after in itertools.pairwise(kept):
        assert after.from_ns <= before.to_ns  # nothing between them is missing


def test_what_is_no_new_alarm_of_the_plant_keeps_nothing() -> None:
    box = BlackBox(N, own=("recording/disk",))
    for message in (raised(event="cleared"), raised("recording/disk"), messages.Sample(), messages.Health()):
        box.on_message(message, 1000)
    assert box.close() is None
    off = BlackBox(0)
    off.on_message(raised(), 1000)
    assert off.close() is None
    assert off.protected_ns(1000) is None


def test_what_it_may_still_need_is_known() -> None:
    box = BlackBox(N)
    assert box.protected_ns(5000) == N  # of an alarm that comes now
    box.on_message(raised(), 5000)
    assert box.protected_ns(5000) == N
    assert box.protected_ns(5500) == 500 + N
    assert box.close() == AlarmInterval(4400, 5600, 5000, "ewma/T")
