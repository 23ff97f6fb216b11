"""The event loop of the nodes: no message is lost, ticks come when they are due, a stop acts at once.

Its clock is the machine's, but for when that is set back.
"""

import signal
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import CommandReply, Health
from reactorwatch.runtime.bus import MAX_BATCH
from reactorwatch.runtime.event_loop import EventLoop, SteadyClock, StopSignal, stop_on_signals
from tests.memory_bus import Exchange, MemoryBus
from tests.running import WITHIN_S, running

FAR = 10**19


class Echo:
    """A node that publishes a Health for all that happens to it."""

    def __init__(self, ticks: int = 0, messages: int | None = None) -> None:
        self.received: list[Encoded] = []
        self.ticks: list[int] = []
        self.stopped = False
        self._ticks, self._messages = ticks, messages

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        self.received.append(message)
        return [Publication("out/message", Health(time_ns=now_ns))]

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply, list[Publication]]:
        return CommandReply(accepted=True, text=question.payload.decode()), []

    def on_tick(self, now_ns: int) -> list[Publication]:
        self.ticks.append(now_ns)
        return [Publication("out/tick", Health(time_ns=now_ns))]

    def next_tick_ns(self) -> int:
        return 0 if len(self.ticks) < self._ticks else FAR

    @property
    def finished(self) -> bool:
        ticked = self._messages is None and len(self.ticks) == self._ticks > 0
        return ticked or (self._messages is not None and len(self.received) >= self._messages)

    def on_stop(self, now_ns: int) -> list[Publication]:
        self.stopped = True
        return [Publication("out/stop", Health(time_ns=now_ns))]


def listening(node: Echo, exchange: Exchange) -> threading.Thread:
    """Start the loop of a node that finishes by itself; it is subscribed on return."""
    loop = EventLoop(node, MemoryBus(exchange), StopSignal())
    loop.subscribe("in/**")
    thread = threading.Thread(target=loop.run)
    thread.start()
    return thread


def test_a_node_that_is_finished_ends_the_loop_with_its_last_words() -> None:
    exchange, said = Exchange(), list[str]()
    MemoryBus(exchange).subscribe("out/*", lambda message: said.append(message.key))
    node = Echo(ticks=3)
    EventLoop(node, MemoryBus(exchange), StopSignal()).run()
    assert said == ["out/tick"] * 3 + ["out/stop"]


def test_every_message_is_handed_over_in_order() -> None:
    exchange = Exchange()
    node, speaker = Echo(messages=5000), MemoryBus(exchange)
    thread = listening(node, exchange)
    for number in range(5000):
        speaker.publish(Encoded(f"in/{number}", b"", ""))
    thread.join(WITHIN_S)
    assert not thread.is_alive()
    assert [message.key for message in node.received] == [f"in/{number}" for number in range(5000)]


def test_a_query_is_answered_by_the_loop_of_the_node_while_its_caller_waits() -> None:
    exchange, stop = Exchange(), StopSignal()
    loop = EventLoop(Echo(), MemoryBus(exchange), stop)
    loop.accept_commands("command/*")
    with running(loop.run, stop):
        (answer,) = MemoryBus(exchange).query(Encoded("command/say", b"heard", ""), WITHIN_S)
    assert CommandReply.FromString(answer.payload).text == "heard"


@pytest.mark.parametrize(("bound", "most"), [("MAX_INBOX_MESSAGES", 100), ("MAX_INBOX_BYTES", 100_000)])
def test_a_publisher_faster_than_a_node_can_receive_is_made_to_wait(
    bound: str, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The inbox stays within its bound, of messages or of bytes, and nothing is lost."""
    monkeypatch.setattr(f"reactorwatch.runtime.event_loop.{bound}", most)
    exchange, count = Exchange(), 5000
    handled, ahead = [0], [0]

    class Slow(Echo):
        def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
            sum(range(2000))
            handled[0] += 1
            return super().on_message(message, now_ns)

    node, speaker = Slow(messages=count), MemoryBus(exchange)
    thread = listening(node, exchange)
    for number in range(count):
        speaker.publish(Encoded(f"in/{number}", bytes(1000), ""))
        ahead[0] = max(ahead[0], number + 1 - handled[0])
    thread.join(WITHIN_S)
    assert not thread.is_alive()
    assert len(node.received) == count
    assert ahead[0] <= 100 + 2


def test_a_node_that_publishes_what_it_receives_itself_does_not_wait_for_room_in_its_full_inbox(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The bus takes a publication only when a receiver that waits for room has handed over the messages before."""
    monkeypatch.setattr("reactorwatch.runtime.event_loop.MAX_INBOX_MESSAGES", 2)
    has_handed_over = threading.Event()
    waits: list[bool] = []

    class Blocking(MemoryBus):
        def publish(self, message: Encoded) -> None:
            waits.append(has_handed_over.wait(WITHIN_S))

    exchange = Exchange()
    loop = EventLoop(Echo(ticks=1), Blocking(exchange), StopSignal())
    loop.subscribe("in/**")
    speaker = MemoryBus(exchange)
    for number in range(2):
        speaker.publish(Encoded(f"in/{number}", b"", ""))

    def receive() -> None:
        for number in range(2, 1000):
            speaker.publish(Encoded(f"in/{number}", b"", ""))
        has_handed_over.set()

    receiver = threading.Thread(target=receive)
    receiver.start()
    loop.run()
    receiver.join(WITHIN_S)
    assert waits[0]


def test_a_stop_wakes_a_loop_that_waits_for_nothing() -> None:
    stop, node = StopSignal(), Echo()
    thread = threading.Thread(target=EventLoop(node, MemoryBus(Exchange()), stop).run)
    thread.start()
    stop.set()
    thread.join(WITHIN_S)
    assert not thread.is_alive()
    assert node.stopped


def test_what_arrived_before_the_stop_is_still_handled() -> None:
    exchange, stop, node = Exchange(), StopSignal(), Echo()
    loop, speaker = EventLoop(node, MemoryBus(exchange), stop), MemoryBus(exchange)
    loop.subscribe("in/**")
    for number in range(1000):
        speaker.publish(Encoded(f"in/{number}", b"", ""))
    stop.set()
    loop.run()
    assert len(node.received) == 1000


def test_what_waits_for_a_missing_message_is_handled_before_the_node_ends() -> None:
    """A recorder that ends while an alarm before others is missing records the others."""
    exchange, stop, node = Exchange(), StopSignal(), Echo()
    bus = MemoryBus(exchange)
    loop = EventLoop(node, bus, stop)
    loop.subscribe("in/**")
    bus.held += [Encoded(f"in/{number}", b"", "") for number in range(3)]
    stop.set()
    loop.run()
    assert [message.key for message in node.received] == ["in/0", "in/1", "in/2"]
    assert node.stopped


def test_a_function_is_called_when_all_messages_that_arrived_before_are_handled_and_its_result_is_published() -> None:
    exchange, stop, node, published = Exchange(), StopSignal(), Echo(), list[str]()
    loop, speaker = EventLoop(node, MemoryBus(exchange), stop), MemoryBus(exchange)
    MemoryBus(exchange).subscribe("out/*", lambda message: published.append(message.key))
    loop.subscribe("in/**")
    for number in range(3):
        speaker.publish(Encoded(f"in/{number}", b"", ""))
        loop.call(lambda now_ns: [Publication(f"out/{len(node.received)}", Health(time_ns=now_ns))])
    stop.set()
    loop.run()
    assert [key for key in published if key != "out/message"] == ["out/1", "out/2", "out/3", "out/stop"]


def test_draining_receives_messages_that_arrive_within_it() -> None:
    exchange, stop, node = Exchange(), StopSignal(), Echo()
    loop = EventLoop(node, MemoryBus(exchange), stop, drain_timeout_s=1.0)
    loop.subscribe("in/**")
    thread = threading.Thread(target=lambda: MemoryBus(exchange).publish(Encoded("in/late", b"", "")))
    stop.set()
    thread.start()
    loop.run()
    thread.join()
    assert [message.key for message in node.received] == ["in/late"]


def test_a_finished_node_blocks_no_publisher(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("reactorwatch.runtime.event_loop.MAX_INBOX_MESSAGES", 10)
    exchange = Exchange()
    node, speaker = Echo(messages=5), MemoryBus(exchange)
    serving = listening(node, exchange)

    def speak() -> None:
        for _ in range(1000):
            speaker.publish(Encoded("in/x", b"", ""))

    speaking = threading.Thread(target=speak, daemon=True)
    speaking.start()
    serving.join(WITHIN_S)
    speaking.join(WITHIN_S)
    assert not speaking.is_alive()


def test_a_bus_that_never_falls_silent_does_not_keep_a_node_from_ending() -> None:
    exchange, stop, node = Exchange(), StopSignal(), Echo()
    loop, speaker = EventLoop(node, MemoryBus(exchange), stop, drain_timeout_s=0.01), MemoryBus(exchange)
    loop.subscribe("in/**")
    ended = threading.Event()

    def chatter() -> None:
        while not ended.is_set():
            speaker.publish(Encoded("in/x", b"", ""))
            time.sleep(0)  # let the loop have its turn

    thread = threading.Thread(target=chatter)
    thread.start()
    stop.set()
    try:
        loop.run()
    finally:
        ended.set()
        thread.join()
    assert node.stopped


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_arrives_while_the_main_thread_holds_a_lock_still_wakes_the_thread_that_needs_it(
    number: signal.Signals,
) -> None:
    lock, woken = threading.Lock(), threading.Event()

    def wake() -> None:
        if lock.acquire(timeout=WITHIN_S):  # as an event's does; a handler that came here itself would never get it
            lock.release()
            woken.set()

    with stop_on_signals() as stop:
        stop.call_on_set(wake)
        with lock:
            signal.raise_signal(number)
            assert not woken.is_set()
        assert woken.wait(WITHIN_S)
        assert stop.is_set


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_the_waiting_main_thread_does_not_notice_stops_it(number: signal.Signals) -> None:
    """As one that comes between its last instruction and its wait: here another thread gets it."""
    woken, waits = threading.Event(), threading.Event()

    def take_the_signal() -> None:
        waits.wait()
        signal.pthread_kill(threading.get_ident(), number)

    with stop_on_signals() as stop:
        stop.call_on_set(woken.set)
        taker = threading.Thread(target=take_the_signal)
        taker.start()
        waits.set()
        assert woken.wait(WITHIN_S)
        taker.join()
        assert stop.is_set


def test_signals_are_handled_as_before_once_the_context_is_left() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with stop_on_signals():
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


class Batched(MemoryBus):
    """A bus that hands over whatever a test gives it."""

    def subscribe_batched(self, key_expression: str, handler: Callable[[list[Encoded]], None], **_others: Any) -> None:
        self.hand_over = handler


@pytest.mark.parametrize(("bound", "most"), [("MAX_INBOX_MESSAGES", 100), ("MAX_INBOX_BYTES", 100_000)])
def test_a_batch_of_messages_is_bounded_in_the_same_way(bound: str, most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"reactorwatch.runtime.event_loop.{bound}", most)
    count, handled, ahead = 5000, [0], [0]
    bus, stop = Batched(Exchange()), StopSignal()

    def on_batch(messages: list[Encoded], _now_ns: int) -> list[Publication]:
        sum(range(20_000))
        handled[0] += len(messages)
        return []

    loop = EventLoop(Echo(), bus, stop)
    loop.subscribe("in/**", on_batch=on_batch)
    thread = threading.Thread(target=loop.run)
    thread.start()
    for number in range(0, count, 10):
        bus.hand_over([Encoded(f"in/{number}", bytes(1000), "")] * 10)
        ahead[0] = max(ahead[0], number + 10 - handled[0])
    stop.set()
    thread.join(WITHIN_S)
    assert not thread.is_alive()
    assert handled[0] == count
    assert ahead[0] <= 100 + 20


def test_a_history_that_comes_at_once_is_handled_in_parts_between_which_the_node_publishes() -> None:
    bus, stop, parts = Batched(Exchange()), StopSignal(), list[int]()
    published = list[int]()

    def on_batch(messages: list[Encoded], _now_ns: int) -> list[Publication]:
        parts.append(len(messages))
        return [Publication("out", Health())]

    loop = EventLoop(Echo(), bus, stop, on_publish=lambda _publication: published.append(len(parts)))
    loop.subscribe("in/**", on_batch=on_batch)
    bus.hand_over([Encoded("in/x", b"", "")] * (2 * MAX_BATCH + 1))
    stop.set()
    loop.run()
    assert parts == [MAX_BATCH, MAX_BATCH, 1]
    assert published[:3] == [1, 2, 3]


def test_messages_are_handed_over_together_in_their_order_and_tokens_as_they_come_and_go() -> None:
    exchange, stop = Exchange(), StopSignal()
    node, speaker = Echo(), MemoryBus(exchange)
    received, alive = list[str](), list[tuple[str, bool]]()

    def on_batch(messages: list[Encoded], _now_ns: int) -> list[Publication]:
        received.extend(message.key for message in messages)
        return []

    def on_token(token: str, is_alive: bool, _now_ns: int) -> list[Publication]:
        alive.append((token, is_alive))
        if not is_alive:
            stop.set()
        return []

    loop = EventLoop(node, MemoryBus(exchange), stop)
    loop.subscribe("in/**", on_batch=on_batch)
    loop.subscribe_liveliness("alive/*", on_token=on_token)
    thread = threading.Thread(target=loop.run)
    thread.start()
    for number in range(1000):
        speaker.publish(Encoded(f"in/{number}", b"", ""))
    speaker.declare_token("alive/x")
    speaker.undeclare_token("alive/x")
    thread.join(WITHIN_S)
    assert not thread.is_alive()
    assert received == [f"in/{number}" for number in range(1000)]
    assert alive == [("alive/x", True), ("alive/x", False)]


SECOND = 1_000_000_000


class Machine:
    """A machine's clocks."""

    def __init__(self) -> None:
        self.passed_ns, self.set_ns = 0, 1_000 * SECOND

    def wall_ns(self) -> int:
        return self.set_ns + self.passed_ns

    def monotonic_ns(self) -> int:
        return self.passed_ns


def test_it_follows_the_machine_s_clock_also_when_that_is_set_forward() -> None:
    machine = Machine()
    clock = SteadyClock(machine.wall_ns, machine.monotonic_ns)
    for step_ns in (0, 1, SECOND, 3600 * SECOND):
        machine.passed_ns += SECOND
        machine.set_ns += step_ns
        assert clock.now_ns() == machine.wall_ns()


def test_when_the_machine_s_clock_is_set_back_it_runs_more_slowly_until_it_is_right_again() -> None:
    machine = Machine()
    clock = SteadyClock(machine.wall_ns, machine.monotonic_ns)
    machine.set_ns -= 60 * SECOND
    ahead = []
    for _ in range(700):
        before_ns = clock.now_ns()
        machine.passed_ns += SECOND
        assert clock.now_ns() - before_ns >= 0.9 * SECOND - 1
        ahead.append(clock.now_ns() - machine.wall_ns())
    assert ahead[0] > 59 * SECOND
    assert ahead == sorted(ahead, reverse=True)
    assert ahead[598] > 0
    assert ahead[-1] == 0
