"""Messages of a publisher are delivered in order, however late they arrive; lost ones are reported."""

import random
from collections.abc import Iterable, Sequence

import pytest

from reactorwatch.runtime import reorder_buffer
from reactorwatch.runtime.reorder_buffer import (
    ORPHAN_TIMEOUT_NS,
    POLL_NS,
    RECOVERY_TIMEOUT_NS,
    START_WINDOW_NS,
    TIMEOUT_NS,
    Gap,
    ReorderBuffer,
)

STREAM = "reactor/x/sample"


def fed(
    order: ReorderBuffer[int], numbers: Iterable[int], now_ns: int = 0, publisher: int = 1, key: str = "T"
) -> list[int | Gap]:
    return [item for number in numbers for item in order.push(publisher, STREAM, key, number, number, now_ns)]


def test_messages_in_order_are_delivered_at_once() -> None:
    order = ReorderBuffer[int]()
    assert fed(order, [0, 1, 2]) == [0, 1, 2]
    assert order.due_ns() is None


def test_messages_recovered_key_by_key_are_delivered_row_by_row() -> None:
    """Three signals; after row 1 a link was down for four rows."""
    order = ReorderBuffer[int]()
    assert fed(order, [0, 1, 2]) == [0, 1, 2]
    blocks = [*range(3, 15, 3), *range(5, 15, 3), *range(4, 15, 3)]
    assert fed(order, blocks) == list(range(3, 15))
    assert order.due_ns() is None


def test_any_order_of_a_stream_that_was_received_from_its_start_is_put_right() -> None:
    for seed in range(50):
        numbers = list(range(1, 40))
        random.Random(seed).shuffle(numbers)
        assert fed(ReorderBuffer[int](), [0, *numbers]) == list(range(40))


def test_a_late_subscriber_sorts_the_first_window_and_then_passes_messages_on_at_once() -> None:
    order = ReorderBuffer[int]()
    assert fed(order, [30, 33, 31, 34, 32]) == []
    assert order.due_ns() == START_WINDOW_NS
    assert list(order.release_overdue(START_WINDOW_NS - 1)) == []
    assert list(order.release_overdue(START_WINDOW_NS)) == [30, 31, 32, 33, 34]
    assert fed(order, [35]) == [35]
    assert order.due_ns() is None


def test_lost_messages_are_reported_when_they_are_given_up_and_the_rest_is_delivered() -> None:
    order = ReorderBuffer[int]()
    assert fed(order, [0, 3, 4, 7], now_ns=10) == [0]
    assert order.due_ns() == 10 + TIMEOUT_NS
    now_ns = 10 + TIMEOUT_NS
    assert list(order.release_overdue(now_ns)) == [Gap(STREAM, 1, 1, 6, 4, now_ns), 3, 4, 7]
    assert fed(order, [8]) == [8]


def test_what_is_missing_before_later_ones_is_waited_for_as_long_again() -> None:
    order = ReorderBuffer[int]()
    fed(order, [0, 2])
    assert fed(order, [4], now_ns=TIMEOUT_NS - 1) == []
    assert list(order.release_overdue(TIMEOUT_NS)) == [Gap(STREAM, 1, 1, 1, 1, TIMEOUT_NS), 2]
    assert order.due_ns() == 2 * TIMEOUT_NS - 1
    assert fed(order, [3], now_ns=TIMEOUT_NS + 1) == [3, 4]


def test_whatever_the_order_of_arrival_nothing_is_waited_for_that_is_over() -> None:
    """What waits first may have come last; then it is known for longer that something is missing before it."""
    order = ReorderBuffer[int]()
    fed(order, [0, 9])
    fed(order, [5, 3], now_ns=1000)
    due_ns = order.due_ns()
    assert due_ns == 1000 + TIMEOUT_NS
    assert list(order.release_overdue(due_ns)) == [Gap(STREAM, 1, 1, 8, 6, due_ns), 3, 5, 9]
    for seed in range(50):
        order, now_ns = ReorderBuffer[int](), 0
        numbers = random.Random(seed).sample(range(1, 60), 30)
        for number in [0, *numbers]:
            now_ns += TIMEOUT_NS // 10
            list(order.push(1, STREAM, "T", number, number, now_ns))
        while (due_ns := order.due_ns()) is not None:
            assert list(order.release_overdue(due_ns)), "it is due, and nothing happens"


def test_a_key_that_is_recovered_long_after_the_others_still_takes_its_places() -> None:
    """Three signals; after row 1 a link was down, and each publisher remembers the last 1,000 of 3,000 rows.

    Zenoh hands on a key when its recovery is over, which takes up to ten seconds more for one than for another.
    """
    order = ReorderBuffer[int]()
    fed(order, [0], key="qc")
    fed(order, [1], key="C")
    fed(order, [2], key="T")
    assert fed(order, range(6000, 9000, 3), now_ns=0, key="qc") == []
    assert fed(order, range(6001, 9000, 3), now_ns=1, key="C") == []
    at_ns = 1
    while (due_ns := order.due_ns()) is not None and due_ns < 2 * TIMEOUT_NS:
        assert list(order.release_overdue(due_ns)) == []
        assert due_ns > at_ns
        at_ns = due_ns
    assert fed(order, range(6002, 9000, 3), now_ns=2 * TIMEOUT_NS, key="T") == []
    due_ns = 3 * TIMEOUT_NS
    assert list(order.release_overdue(due_ns)) == [Gap(STREAM, 1, 3, 5999, 5997, due_ns), *range(6000, 9000)]
    assert order.due_ns() is None


def test_a_key_that_has_fallen_silent_is_not_waited_for_for_ever() -> None:
    order = ReorderBuffer[int]()
    fed(order, [0], key="C")
    fed(order, [1, 3], key="T")
    assert list(order.release_overdue(TIMEOUT_NS)) == []
    assert order.due_ns() == TIMEOUT_NS + POLL_NS
    assert list(order.release_overdue(RECOVERY_TIMEOUT_NS)) == [Gap(STREAM, 1, 2, 2, 1, RECOVERY_TIMEOUT_NS), 3]


def test_what_every_key_has_passed_is_given_up_while_the_rest_is_waited_for() -> None:
    order = ReorderBuffer[int]()
    fed(order, [0, 4, 8], key="C")
    fed(order, [5], key="T")
    assert list(order.release_overdue(TIMEOUT_NS)) == [Gap(STREAM, 1, 1, 3, 3, TIMEOUT_NS), 4, 5]
    assert fed(order, [7], now_ns=TIMEOUT_NS, key="T") == []
    due_ns = 2 * TIMEOUT_NS
    assert list(order.release_overdue(due_ns)) == [Gap(STREAM, 1, 6, 6, 1, due_ns), 7, 8]


def test_what_is_missing_later_is_waited_for_as_long_by_itself() -> None:
    order = ReorderBuffer[int]()
    fed(order, [0], key="C")
    fed(order, [1, 3], key="T")
    fed(order, [5], now_ns=RECOVERY_TIMEOUT_NS - 1, key="T")
    assert list(order.release_overdue(RECOVERY_TIMEOUT_NS)) == [Gap(STREAM, 1, 2, 2, 1, RECOVERY_TIMEOUT_NS), 3]
    assert list(order.release_overdue(2 * RECOVERY_TIMEOUT_NS - 2)) == []
    assert fed(order, [4], now_ns=2 * RECOVERY_TIMEOUT_NS - 2, key="C") == [4, 5]


def test_a_silent_key_with_a_reported_last_number_may_be_recovered() -> None:
    order = ReorderBuffer[int](await_history=True)
    order.set_last(1, STREAM, "C", 3)
    order.set_last(1, STREAM, "T", 4)
    assert list(order.end_history(0)) == []
    fed(order, [6], key="T")
    assert list(order.release_overdue(TIMEOUT_NS)) == []
    assert fed(order, [5], now_ns=TIMEOUT_NS, key="C") == [5, 6]


def test_keys_that_each_keep_their_order_make_one_order_whatever_is_lost_and_however_late_they_are() -> None:
    """A fifth of all is lost; each key stands still at times, for less than a recovery takes."""
    for seed in range(50):
        draw = random.Random(seed)
        order, now_ns, heard = ReorderBuffer[int](), 0, list[int | Gap]()
        came = [number for number in range(1, 200) if draw.random() < 0.8]
        waiting = {key: [number for number in came if number % 3 == key] for key in range(3)}
        heard += fed(order, [0], key="0")
        for key in (1, 2):
            order.set_last(1, STREAM, str(key), 0)
        while any(waiting.values()):
            now_ns += draw.randrange(RECOVERY_TIMEOUT_NS // 20)
            key = draw.choice([key for key, rest in waiting.items() if rest])
            burst, waiting[key] = waiting[key][:9], waiting[key][9:]
            heard += fed(order, burst, now_ns, key=str(key))
            heard += order.release_overdue(now_ns)
        while (due_ns := order.due_ns()) is not None:
            heard += order.release_overdue(due_ns)
        assert [item for item in heard if isinstance(item, int)] == [0, *came]
        assert sum(item.messages for item in heard if isinstance(item, Gap)) == came[-1] - len(came)


def test_a_message_that_arrives_after_it_was_given_up_is_delivered_at_once() -> None:
    order = ReorderBuffer[int]()
    fed(order, [0, 2])
    list(order.release_overdue(TIMEOUT_NS))
    assert fed(order, [1, 1, 3]) == [1, 3]
    fed(order, range(4, 8004, 2))
    due_ns = order.due_ns()
    assert due_ns is not None
    list(order.release_overdue(due_ns))
    late = list(range(5, 8001, 2))
    random.Random(1).shuffle(late)
    assert fed(order, late) == late


def test_what_comes_again_and_what_was_before_the_first_is_passed_over() -> None:
    order = ReorderBuffer[int]()
    fed(order, [5, 6])
    assert list(order.release_overdue(START_WINDOW_NS)) == [5, 6]
    assert fed(order, [3, 5, 6, 7]) == [7]


def test_a_new_subscriber_receives_only_messages_after_its_start() -> None:
    """Number 7 came live before the publisher said that it had come to 8; 9 after."""
    order = ReorderBuffer[int](await_history=True)
    assert fed(order, [7, 9]) == []
    order.set_last(1, STREAM, "T", 6)
    order.set_last(1, STREAM, "T", 8)
    assert order.due_ns() is None
    assert list(order.end_history(1)) == [9]
    assert fed(order, [3, 8, 10]) == [10]


def test_a_publisher_that_publishes_nothing_more_is_known_by_its_last_number() -> None:
    order = ReorderBuffer[int](await_history=True)
    order.set_last(1, STREAM, "T", 8)
    assert list(order.end_history(1)) == []
    assert fed(order, [0, 3, 8, 9]) == [9]


def test_a_subscriber_with_history_receives_it_first_once_and_in_order() -> None:
    order = ReorderBuffer[int](await_history=True)
    assert fed(order, [1, 9, 10, 11]) == []
    order.set_last(1, STREAM, "T", 9)
    for number in (3, 6, 9, 4, 7, 10, 5, 8):
        order.add_history(1, STREAM, "T", number, number)
    assert list(order.end_history(1)) == list(range(3, 12))
    assert fed(order, [2, 10, 12]) == [12]


def test_the_history_is_delivered_when_nothing_is_missing_up_to_the_live_messages() -> None:
    """Two keys by turns; 7 was published after its key was asked, and thrown away on the way."""
    order = ReorderBuffer[int](await_history=True)
    assert order.history_complete()
    order.set_last(1, STREAM, "C", 4)
    order.set_last(1, STREAM, "T", 5)
    for number, key in ((0, "C"), (2, "C"), (4, "C"), (1, "T"), (3, "T")):
        order.add_history(1, STREAM, key, number, number)
        assert not order.history_complete()
    order.add_history(1, STREAM, "T", 5, 5)
    assert order.history_complete()
    fed(order, [6, 8], key="C")
    fed(order, [9], key="T")
    assert not order.history_complete()
    order.add_history(1, STREAM, "T", 7, 7)
    assert order.history_complete()
    assert list(order.end_history(0)) == list(range(10))


def test_a_message_that_arrived_live_is_not_missing_from_the_history() -> None:
    """Number 4 arrived live, its publisher had come to 5 when it was queried, and the reply with 4 was lost."""
    order = ReorderBuffer[int](await_history=True)
    fed(order, [4, 5, 6])
    order.set_last(1, STREAM, "T", 5)
    for number in (2, 3, 5):
        order.add_history(1, STREAM, "T", number, number)
    assert order.history_complete()
    assert list(order.end_history(0)) == [2, 3, 4, 5, 6]
    assert order.due_ns() is None


@pytest.mark.parametrize(
    ("recent", "held", "history", "complete"),
    [
        (True, [], {}, False),
        (False, [], {}, True),
        (False, [7], {}, False),
        (False, [0], {}, True),
        (False, [], {"C": range(0, 60, 2), "T": range(1, 60, 2)}, True),
        (False, [], {"C": range(0, 60, 2), "T": range(5, 60, 2)}, False),
        (False, [], {"C": range(60), "alarm": [60]}, True),
        (False, [], {"C": [*range(20), *range(21, 50)], "model": [20, 50, 80], "T": range(51, 80)}, False),
    ],
    ids=[
        "recent and lost",
        "long ago",
        "live and lost",
        "it has just begun",
        "two keys by turns",
        "the begin of a key is lost",
        "a rare key",
        "the begin of a key is lost, beside a rare one",
    ],
)
def test_a_history_is_incomplete_where_replies_were_lost_as_a_whole(
    recent: bool, held: list[int], history: dict[str, Sequence[int]], complete: bool
) -> None:
    order = ReorderBuffer[int](await_history=True)
    if not held:
        order.set_last(1, STREAM, "C", max([0, *(max(numbers) for numbers in history.values())]), is_recent=recent)
    fed(order, held, key="C")
    for key, numbers in history.items():
        for number in numbers:
            assert order.add_history(1, STREAM, key, number, number)
            assert not order.add_history(1, STREAM, key, number, number)
    assert order.history_complete() == complete


@pytest.mark.parametrize(("newest", "late"), [(14, [7]), (15, []), (99, [])])
def test_what_arrives_later_than_its_subscriber_can_use_is_dropped(newest: int, late: list[int]) -> None:
    """At most four messages of each of the two keys behind the next one."""
    order = ReorderBuffer[int](late_rows=4)
    fed(order, [0], key="C")
    fed(order, [1], key="T")
    fed(order, [9], key="C")
    assert list(order.release_overdue(RECOVERY_TIMEOUT_NS)) == [Gap(STREAM, 1, 2, 8, 7, RECOVERY_TIMEOUT_NS), 9]
    assert fed(order, range(10, newest + 1)) == list(range(10, newest + 1))
    assert fed(order, [7], key="C") == late
    assert fed(order, [7], key="C") == []


def test_a_partial_history_of_some_keys_is_delivered_first_and_is_no_gap() -> None:
    order = ReorderBuffer[int](await_history=True)
    for number, key in ((1, "C"), (3, "C"), (5, "C"), (4, "T"), (6, "T")):
        order.add_history(1, STREAM, key, number, number)
    assert order.history_complete()
    assert list(order.end_history(0)) == [1, 3, 4, 5, 6]
    assert fed(order, [7]) == [7]
    assert order.due_ns() is None


def test_a_publisher_that_appears_during_the_history_query_is_received_from_its_start() -> None:
    order = ReorderBuffer[int](await_history=True)
    assert fed(order, [0, 1]) == []
    assert list(order.end_history(1)) == [0, 1]


def test_a_recovery_is_waited_for_as_long_as_it_lasts() -> None:
    order = ReorderBuffer[int]()
    fed(order, [0, 10, 12])
    assert fed(order, [1], now_ns=4 * 10**9) == [1]
    assert order.due_ns() == 4 * 10**9 + TIMEOUT_NS


def test_publishers_and_streams_do_not_wait_for_each_other() -> None:
    order = ReorderBuffer[int]()
    fed(order, [0, 2])
    assert fed(order, [0, 1], publisher=2) == [0, 1]
    assert list(order.push(1, "reactor/x/alarm", "ewma", 0, 5, 0)) == [5]


def test_a_late_listener_gathers_as_long_as_older_ones_come_and_not_as_long_as_newer_ones_do() -> None:
    order = ReorderBuffer[int]()
    assert fed(order, [30, 40], now_ns=0) == []
    assert fed(order, [31], now_ns=START_WINDOW_NS // 2) == []
    assert fed(order, [41], now_ns=START_WINDOW_NS) == []
    assert order.due_ns() == START_WINDOW_NS // 2 + START_WINDOW_NS


def test_no_more_wait_than_memory_has_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reorder_buffer, "MAX_HELD", 100)
    order = ReorderBuffer[int]()
    fed(order, [0])
    assert fed(order, list(range(2, 103))) == [Gap(STREAM, 1, 1, 1, 1, 0), *range(2, 103)]


def test_no_more_bytes_wait_than_memory_has_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reorder_buffer, "MAX_HELD_BYTES", 1000)
    order = ReorderBuffer[int](size=lambda _: 100)
    fed(order, [0])
    assert fed(order, list(range(2, 13))) == [Gap(STREAM, 1, 1, 1, 1, 0), *range(2, 13)]
    assert fed(order, [14]) == []  # there is room again


def test_during_the_history_no_more_messages_wait_than_the_capacity(monkeypatch: pytest.MonkeyPatch) -> None:
    """What did not find room is told as missing."""
    monkeypatch.setattr(reorder_buffer, "MAX_HELD", 10)
    order = ReorderBuffer[int](await_history=True)
    assert fed(order, range(100)) == []
    told = [*order.end_history(0), *fed(order, [100, 101])]
    told += order.release_overdue(TIMEOUT_NS)
    assert [item for item in told if not isinstance(item, Gap)] == [*range(11), 100, 101]
    assert [(item.first, item.last) for item in told if isinstance(item, Gap)] == [(11, 99)]


def test_idle_publishers_are_evicted_and_the_active_one_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reorder_buffer, "MAX_STREAMS", 100)
    order = ReorderBuffer[int]()
    for number in range(1000):
        assert fed(order, [number], now_ns=number) == [number]
        assert fed(order, [0], now_ns=number, publisher=2 + number) == [0]
        assert len(order._streams) <= 100
    assert fed(order, [1001, 1000], now_ns=1000) == [1000, 1001]


def test_keys_without_number_are_not_all_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reorder_buffer, "MAX_KEYS", 10)
    order = ReorderBuffer[int]()
    assert [item for number in range(100) for item in fed(order, [number], key=f"x{number}")] == list(range(100))
    assert len(order._streams[1, STREAM].keys) == 10


def test_the_fast_way_is_for_keys_that_are_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reorder_buffer, "MAX_KEYS", 10)
    order = ReorderBuffer[int]()
    fed(order, [0], key="x0")
    for number in range(1, 100):
        assert not order.accept_next(1, f"x{number}", number, 0)
        assert fed(order, [number], key=f"x{number}") == [number]
    assert [order.accept_next(1, f"x{100 + place}", 100 + place, 0) for place in range(3)] == [False] * 3
    assert [order.accept_next(1, f"x{place}", 100 + place, 0) for place in range(10)] == [True] * 10


def test_the_fast_path_is_for_the_last_active_publisher() -> None:
    order = ReorderBuffer[int]()
    assert fed(order, [0, 1]) == [0, 1]
    assert not order.accept_next(2, "T", 2, 0)
    assert fed(order, [0], publisher=2) == [0]
    assert not order.accept_next(1, "T", 2, 0)
    assert order.accept_next(2, "T", 1, 0)


def test_the_fast_way_is_closed_while_something_is_waited_for() -> None:
    order = ReorderBuffer[int]()
    assert fed(order, [0, 2]) == [0]
    assert not order.accept_next(1, "T", 1, 0)
    assert fed(order, [1]) == [1, 2]
    assert order.accept_next(1, "T", 3, 0)


def test_unannounced_publishers_of_one_message_are_evicted() -> None:
    """Garbage, with something like a publisher and a number, makes a stream each."""
    order = ReorderBuffer[int]()
    fed(order, [0])
    for number in range(1, 10_000):
        now_ns = number * ORPHAN_TIMEOUT_NS // 1000
        assert order.accept_next(1, "T", number, now_ns) or fed(order, [number], now_ns=now_ns) == [number]
        assert fed(order, [2**40 + number], now_ns=now_ns, publisher=1 + number) == []
        if (due_ns := order.due_ns()) is not None and due_ns <= now_ns:
            list(order.release_overdue(now_ns))
        assert len(order._streams) <= 1002  # those of the last minute, and the plant's


def test_a_flood_of_made_up_publishers_pushes_out_its_own_and_not_those_that_are_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """More of them in a minute than there is room for: the plant's own alarms may be silent for longer than they."""
    monkeypatch.setattr(reorder_buffer, "MAX_STREAMS", 100)
    order = ReorderBuffer[int]()
    assert fed(order, [0, 1]) == [0, 1]
    for number in range(1000):
        fed(order, [2**40], now_ns=number, publisher=2 + number)
        list(order.release_overdue(number + START_WINDOW_NS))
        assert len(order._streams) <= 100
        assert len(order._unconfirmed) <= 100
    assert fed(order, [3, 2], now_ns=1000) == [2, 3]


def test_publishers_that_were_announced_or_received_from_their_start_are_not_evicted() -> None:
    """Of an alarm there may be a message a day."""
    order = ReorderBuffer[int](await_history=True)
    order.set_last(1, STREAM, "T", 7)
    assert list(order.end_history(0)) == []
    assert fed(order, [0], publisher=2) == [0]
    for number in range(1000):
        fed(order, [2**40], now_ns=2 * number * ORPHAN_TIMEOUT_NS, publisher=3 + number)
        assert order.due_ns() is not None
        list(order.release_overdue(2 * number * ORPHAN_TIMEOUT_NS + START_WINDOW_NS))
    assert fed(order, [9, 8]) == [8, 9]
    assert fed(order, [2, 1], publisher=2) == [1, 2]


def test_the_active_publisher_on_the_fast_path_is_not_evicted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reorder_buffer, "MAX_STREAMS", 100)
    order = ReorderBuffer[int]()
    assert fed(order, [0]) == [0]
    for number in range(1, 1000):
        assert order.accept_next(1, "T", number, number)
        assert fed(order, [0], now_ns=number, publisher=1 + number, key="C") == [0]
