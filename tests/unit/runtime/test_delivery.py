"""Delivery from a bus to a subscriber: one order, whatever the thread, and nothing older than requested."""

import time
from collections.abc import Callable
from math import inf, isinf
from queue import SimpleQueue
from types import SimpleNamespace

import pytest

from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime import reorder_buffer
from reactorwatch.runtime.delivery import Delivery, SequencedMessage
from reactorwatch.runtime.reorder_buffer import Gap
from tests.running import WITHIN_S

SECOND = 10**9


def message(number: int) -> SequencedMessage:
    sample = Encoded("reactor/x/sample/T", str(number).encode(), "", time.time_ns())
    return SequencedMessage(1, number, sample)


def each(received: "SimpleQueue[Encoded | Gap]") -> Callable[[list[Encoded]], None]:
    """Puts what is handed on together into a queue, one by one."""

    def put(messages: list[Encoded]) -> None:
        for message in messages:
            received.put(message)

    return put


def taken(received: "SimpleQueue[Encoded | Gap]") -> list[str]:
    """The numbers that were handed on, so far."""
    items = [received.get_nowait() for _ in range(received.qsize())]
    return [item.payload.decode() for item in items if isinstance(item, Encoded)]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Clock of the delivery, which a test sets."""
    clock = SimpleNamespace(now_ns=SECOND)
    times = SimpleNamespace(monotonic_ns=lambda: clock.now_ns, time_ns=time.time_ns)
    monkeypatch.setattr("reactorwatch.runtime.delivery.time", times)
    return clock


def test_a_thread_of_its_own_gives_up_what_never_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reorder_buffer, "TIMEOUT_NS", 1_000_000)
    received: SimpleQueue[Encoded | Gap] = SimpleQueue()
    delivery = Delivery(each(received), received.put)
    delivery.start()
    for number in (0, 3):
        delivery.receive([message(number)])
    items = [received.get(timeout=WITHIN_S) for _ in range(3)]
    delivery.close()
    gap = items[1]
    assert isinstance(gap, Gap)
    assert (gap.first, gap.last, gap.messages) == (1, 2, 2)
    assert abs(gap.noticed_ns - time.time_ns()) < 3600 * SECOND


def test_what_is_missing_is_asked_for_before_it_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reorder_buffer, "TIMEOUT_NS", 1_000_000)
    received: SimpleQueue[Encoded | Gap] = SimpleQueue()
    asked: list[tuple[str, float]] = []

    def ask(stream: str, since_s: float) -> list[SequencedMessage]:
        asked.append((stream, since_s))
        return [message(number) for number in (0, 1, 3)]

    delivery = Delivery(each(received), received.put, ask)
    delivery.start()
    delivery.receive([message(0)])
    delivery.receive([message(3)])
    items = [received.get(timeout=WITHIN_S) for _ in range(4)]
    delivery.close()
    assert [item.payload.decode() if isinstance(item, Encoded) else item[2:5] for item in items] == [
        "0",
        "1",
        (2, 2, 1),
        "3",
    ]
    ((stream, since_s),) = asked
    assert stream == "reactor/x/sample"
    assert 0.0 < since_s < WITHIN_S


@pytest.mark.parametrize("before", [1, 3])
def test_the_query_reaches_back_to_the_message_before_the_gap(clock: SimpleNamespace, before: int) -> None:
    """Between them the link was down for a minute, and all that is missing was published then."""
    received: SimpleQueue[Encoded | Gap] = SimpleQueue()
    asked: SimpleQueue[float] = SimpleQueue()

    def ask(stream: str, since_s: float) -> list[SequencedMessage]:
        asked.put(since_s)
        return [message(number) for number in range(before, before + 2)]

    delivery = Delivery(each(received), received.put, ask)
    delivery.start()
    delivery.receive([message(number) for number in range(before)])
    clock.now_ns += 60 * SECOND
    delivery.receive([message(before + 2)])
    clock.now_ns += reorder_buffer.TIMEOUT_NS
    delivery.receive([message(before + 3)])
    assert asked.get(timeout=WITHIN_S) == 60.0 + reorder_buffer.TIMEOUT_NS / 1e9
    items = [received.get(timeout=WITHIN_S) for _ in range(before + 4)]
    delivery.close()
    assert [item.payload.decode() for item in items if isinstance(item, Encoded)] == [*map(str, range(before + 4))]


def test_a_gap_that_was_long_on_its_way_is_queried_in_all_that_is_cached(clock: SimpleNamespace) -> None:
    """A busy subscriber takes a message long after its publication, so what is missing is older than it seems."""
    received: SimpleQueue[Encoded | Gap] = SimpleQueue()
    queried: SimpleQueue[float] = SimpleQueue()

    def query(_stream: str, since_s: float) -> list[SequencedMessage]:
        queried.put(since_s)
        return [message(number) for number in range(0 if isinf(since_s) else 2, 4)]

    delivery = Delivery(each(received), received.put, query)
    delivery.start()
    delivery.receive([message(0)])
    delivery.receive([message(3)])
    clock.now_ns += reorder_buffer.TIMEOUT_NS
    delivery.receive([message(4)])
    items = [received.get(timeout=WITHIN_S) for _ in range(5)]
    delivery.close()
    assert [item.payload.decode() for item in items if isinstance(item, Encoded)] == [*map(str, range(5))]
    assert [queried.get_nowait() for _ in range(queried.qsize())] == [reorder_buffer.TIMEOUT_NS / 1e9, inf]


def test_replies_that_a_cache_no_longer_has_are_delivered_and_all_of_it_is_queried_once_a_minute(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The cache is too small for either gap: its answers begin behind them, and the query for all finds nothing."""
    monkeypatch.setattr(reorder_buffer, "TIMEOUT_NS", 1_000_000)
    monkeypatch.setattr(reorder_buffer, "RECOVERY_TIMEOUT_NS", 2_000_000)
    received: SimpleQueue[Encoded | Gap] = SimpleQueue()
    queried: SimpleQueue[float] = SimpleQueue()

    def query(_stream: str, since_s: float) -> list[SequencedMessage]:
        queried.put(since_s)
        return [] if isinf(since_s) else [message(newest[0] - 1)]

    newest = [0]
    delivery = Delivery(each(received), received.put, query)
    delivery.start()
    items = []
    for newest[0] in (0, 4, 9):
        delivery.receive([message(newest[0])])
        items += [received.get(timeout=WITHIN_S) for _ in range(3 if newest[0] else 1)]
    delivery.close()
    found = [(item.first, item.last) if isinstance(item, Gap) else int(item.payload) for item in items]
    assert found == [0, (1, 2), 3, 4, (5, 7), 8, 9]
    assert [isinf(queried.get_nowait()) for _ in range(queried.qsize())] == [False, True, False]


def test_a_stream_that_began_while_the_link_was_down_is_asked_for_from_its_beginning(clock: SimpleNamespace) -> None:
    """And again only for what was published since: a made-up publisher costs its victim little."""
    received: SimpleQueue[Encoded | Gap] = SimpleQueue()
    asked: SimpleQueue[float] = SimpleQueue()

    def ask(stream: str, since_s: float) -> list[SequencedMessage]:
        asked.put(since_s)
        return [message(number) for number in range(100)]

    delivery = Delivery(each(received), received.put, ask)
    delivery.start()
    clock.now_ns += 600 * SECOND  # the link was down for most of them
    delivery.receive([message(70)])
    clock.now_ns += SECOND
    delivery.receive([message(71)])
    assert asked.get(timeout=WITHIN_S) == 601.0
    items = [received.get(timeout=WITHIN_S) for _ in range(100)]
    assert [item.payload.decode() for item in items if isinstance(item, Encoded)] == [*map(str, range(100))]
    for made_up in (2, 3):
        clock.now_ns += 10 * SECOND
        delivery.receive([message(7)._replace(publisher=made_up)])
        clock.now_ns += SECOND
        delivery.receive([message(8)._replace(publisher=made_up)])
        asked_s = asked.get(timeout=WITHIN_S)
        assert [received.get(timeout=WITHIN_S) for _ in range(2)]
    delivery.close()
    assert asked_s == 11.0


def test_each_stream_is_asked_for_before_its_messages_are_given_up(
    clock: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another stream was asked for while a message of this one was missing already, but not yet overdue."""
    timeout_ns = 20_000_000
    monkeypatch.setattr(reorder_buffer, "TIMEOUT_NS", timeout_ns)
    received: SimpleQueue[Encoded | Gap] = SimpleQueue()
    asked: SimpleQueue[str] = SimpleQueue()

    def of(kind: str, number: int) -> SequencedMessage:
        return SequencedMessage(1, number, Encoded(f"reactor/x/{kind}/T", str(number).encode(), ""))

    def ask(stream: str, _since_s: float) -> list[SequencedMessage]:
        asked.put(stream)
        return [of(stream.split("/")[2], 1)]

    delivery = Delivery(each(received), received.put, ask)
    delivery.start()
    delivery.receive([of("estimate", 0), of("chart", 0)])
    delivery.receive([of("estimate", 2)])
    clock.now_ns += timeout_ns // 2
    delivery.receive([of("chart", 2)])
    for stream in ("reactor/x/estimate", "reactor/x/chart"):
        clock.now_ns += timeout_ns // 2
        assert asked.get(timeout=WITHIN_S) == stream
    items = [received.get(timeout=WITHIN_S) for _ in range(6)]
    delivery.close()
    assert not any(isinstance(item, Gap) for item in items)


def test_what_waits_is_handed_on_when_the_bus_is_closed() -> None:
    received: SimpleQueue[Encoded | Gap] = SimpleQueue()
    delivery = Delivery(each(received), received.put)
    delivery.start()
    for number in (0, 3):
        delivery.receive([message(number)])
    delivery.close()
    assert taken(received) == ["0", "3"]


def test_pending_messages_are_delivered_on_request_and_delivery_continues() -> None:
    received: SimpleQueue[Encoded | Gap] = SimpleQueue()
    delivery = Delivery(each(received), received.put)
    delivery.start()
    for number in (0, 3):
        delivery.receive([message(number)])
    delivery.flush_deliveries()
    assert taken(received) == ["0", "3"]
    delivery.receive([message(4)])
    delivery.close()
    assert taken(received) == ["4"]


def test_nothing_is_delivered_before_the_history_is_complete() -> None:
    received: SimpleQueue[Encoded | Gap] = SimpleQueue()
    delivery = Delivery(each(received), received.put)
    delivery.receive([message(9)])
    delivery.set_last(message(8))
    delivery.add_history(message(7))
    assert not delivery.history_complete()
    delivery.add_history(message(8))
    assert delivery.history_complete()
    assert taken(received) == []
    delivery.start()
    assert taken(received) == ["7", "8", "9"]
    delivery.close()
