"""The loop of every node: wait for a message, a command or the next moment something is due; hand it to the core.

The core says what it wants published and when it wants to be woken; the loop alone reads the clock, listens to
signals and touches the bus. It also publishes a record of each command and its answer (`audit`). Handlers of the bus
run in its own threads and only put what came into the inbox.
"""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from queue import Empty, SimpleQueue
from types import FrameType
from typing import NamedTuple, Protocol, TypeAlias

from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.contract.messages_pb2 import CommandReply
from reactorwatch.runtime.bus import Bus, Request
from reactorwatch.runtime.clock import SteadyClock
from reactorwatch.runtime.delivery.reorder_buffer import Gap
from reactorwatch.runtime.security.audit import audit

LONGEST_WAIT_S = 3600.0
LONGEST_LINGER = 10  # times linger_s: a bus that never falls silent does not keep a node from ending
LARGEST_INBOX = (
    100_000  # messages; beyond it the bus is made to wait, and with it who publishes faster than we can hear
)
LARGEST_INBOX_BYTES = 64 << 20  # of payload, likewise
LOOK_AGAIN_S = 0.1
_END = b"\0"  # no signal has this number
BATCH = 256  # messages handled before the loop looks at the clock again


class Node(Protocol):
    """What the loop drives: a core, or a core with the files it works on."""

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Something was published on a key that the node listens to."""

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply | None, list[Publication]]:
        """Somebody asked at one of the node's queryables; None: the answer is another's to give."""

    def on_tick(self, now_ns: int) -> list[Publication]:
        """The moment named by `next_tick_ns` has come."""

    def next_tick_ns(self) -> int:
        """When the node wants `on_tick` called next, by the clock that `now_ns` is read from."""

    @property
    def finished(self) -> bool:
        """Whether the node has nothing left to do and the loop should end."""

    def on_stop(self, now_ns: int) -> list[Publication]:
        """The loop ends; last words."""


class Token(NamedTuple):
    """A liveliness token that came or went."""

    key: str
    is_alive: bool


class _Told:
    """Stands in the inbox behind what was before."""


_TOLD = _Told()
_Item: TypeAlias = Encoded | list[Encoded] | Token | Gap | Request | _Told


class _Weight:
    """Messages in an inbox, and the bytes of their payload, counted by several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._messages, self._bytes = 0, 0

    def add(self, item: _Item, sign: int) -> None:
        """Count an item that comes (1) or goes (-1)."""
        if isinstance(item, Encoded):
            messages, payload = 1, len(item.payload)
        elif isinstance(item, list):
            messages, payload = len(item), sum(len(message.payload) for message in item)
        else:
            return
        with self._lock:
            self._messages += sign * messages
            self._bytes += sign * payload

    @property
    def is_full(self) -> bool:
        """Whether there is no room for more."""
        return self._messages >= LARGEST_INBOX or self._bytes >= LARGEST_INBOX_BYTES


class StopSignal:
    """Set once, by a signal or by another thread, and heard by a loop that waits."""

    def __init__(self) -> None:
        self._set = False
        self._wake: list[Callable[[], None]] = []

    def set(self) -> None:
        """Ask the loop to end."""
        self._set = True
        for wake in self._wake:
            wake()

    @property
    def is_set(self) -> bool:
        """Whether the loop was asked to end."""
        return self._set

    def wakes(self, wake: Callable[[], None]) -> None:
        """Have `wake` called when the signal is set."""
        self._wake.append(wake)


@contextlib.contextmanager
def stop_on_signals() -> Iterator[StopSignal]:
    """A stop signal that SIGINT (Ctrl-C) and SIGTERM set, while the context lasts.

    A handler of Python runs in the main thread between two of its instructions: whatever lock that thread holds just
    then, and not before it has waited to the end if the signal came just before it began to wait. So the handler does
    nothing; the interpreter writes the signal's number into a pipe at once (`signal.set_wakeup_fd`), and a thread that
    reads it wakes the others.
    """
    stop = StopSignal()
    source, sink = os.pipe()
    os.set_blocking(sink, False)

    def handler(_number: int, _frame: FrameType | None) -> None:
        pass

    def wake_when_asked() -> None:
        while _END not in (numbers := os.read(source, 64)):
            if set(numbers) & {signal.SIGINT, signal.SIGTERM}:
                stop.set()

    waker = threading.Thread(target=wake_when_asked, name="stop", daemon=True)
    waker.start()
    previous = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    previous_fd = signal.set_wakeup_fd(sink, warn_on_full_buffer=False)
    try:
        yield stop
    finally:
        signal.set_wakeup_fd(previous_fd)
        for number, old in previous.items():
            signal.signal(number, old)
        os.write(sink, _END)
        waker.join()
        os.close(source)
        os.close(sink)


def serve(
    node: Node,
    bus: Bus,
    stop: StopSignal,
    *,
    subscriptions: tuple[str, ...] = (),
    history_s: float = 0.0,
    on_gap: Callable[[Gap, int], list[Publication]] | None = None,
    on_told: Callable[[], None] | None = None,
    on_messages: Callable[[list[Encoded], int], list[Publication]] | None = None,
    tokens: tuple[str, ...] = (),
    on_alive: Callable[[str, bool, int], list[Publication]] | None = None,
    commands: tuple[str, ...] = (),
    on_ready: Callable[[], None] | None = None,
    linger_s: float = 0.0,
    on_publish: Callable[[Publication], None] | None = None,
) -> None:
    """Run a node until it is finished or asked to stop.

    Args:
        node: the node.
        bus: an open bus; it stays open.
        stop: ends the loop; what is in the inbox by then is still handled.
        subscriptions: key expressions whose publications go to `node.on_message`.
        history_s: whether those from before do, too, see `Bus.subscribe`.
        on_gap: told, in its turn between the messages, what was published on them and never came, and what time it is.
        on_told: called, in its turn between the messages, when those from before have all come.
        on_messages: gets the publications instead, as many at a time as have come, in their order.
        tokens: key expressions of liveliness tokens ...
        on_alive: ... that it is told of: the token, whether it came or went, and what time it is.
        commands: key expressions of queryables whose questions go to `node.on_command`.
        on_ready: called once the node listens.
        linger_s: after the end was asked for, go on until nothing has come for this long (at most ten times it).
        on_publish: told of each thing that the node publishes, before the bus is, in the loop's own thread.
    """
    inbox: SimpleQueue[_Item | None] = SimpleQueue()
    clock = SteadyClock()
    weight, room, ended = _Weight(), threading.Event(), threading.Event()
    stop.wakes(lambda: inbox.put(None))
    stop.wakes(room.set)

    def receive(item: _Item) -> None:
        while weight.is_full and not (stop.is_set or ended.is_set()):
            room.clear()
            room.wait(LOOK_AGAIN_S)
        weight.add(item, 1)
        inbox.put(item)

    for expression in subscriptions:
        listen = bus.subscribe if on_messages is None else bus.gather
        listen(
            expression,
            receive,
            on_gap=receive if on_gap is not None else None,
            history_s=history_s,
            on_told=(lambda: receive(_TOLD)) if on_told is not None else None,
        )
    for expression in tokens:
        bus.watch_alive(expression, lambda key, is_alive: inbox.put(Token(key, is_alive)))
    for expression in commands:
        bus.answer(expression, receive)
    if on_ready is not None:
        on_ready()

    def publish(publications: list[Publication]) -> None:
        for publication in publications:
            if on_publish is not None:
                on_publish(publication)
            bus.publish(encode(publication))

    def handle(item: _Item) -> None:
        weight.add(item, -1)
        if isinstance(item, Encoded):
            publish(node.on_message(item, clock.now_ns()))
        elif isinstance(item, list):
            publish(on_messages(item, clock.now_ns()) if on_messages is not None else [])
        elif isinstance(item, Token):
            publish(on_alive(item.key, item.is_alive, clock.now_ns()) if on_alive is not None else [])
        elif isinstance(item, _Told):
            if on_told is not None:
                on_told()
        elif isinstance(item, Gap):
            publish(on_gap(item, clock.now_ns()) if on_gap is not None else [])
        else:
            reply, publications = node.on_command(item.question, clock.now_ns())
            if reply is None:
                item.leave()
                return
            item.reply(reply)
            record = audit(item.question, reply, clock.now_ns())
            publish(publications if record is None else [*publications, record])

    while not (stop.is_set or node.finished):
        wait_s = (node.next_tick_ns() - clock.now_ns()) / 1e9
        if wait_s <= 0:
            publish(node.on_tick(clock.now_ns()))
            wait_s = 0.0
        handled = 0
        while handled < BATCH:
            try:
                item = inbox.get(timeout=min(wait_s, LONGEST_WAIT_S)) if wait_s > 0 else inbox.get_nowait()
            except Empty:
                break
            if item is None:
                break
            handle(item)
            handled += len(item) if isinstance(item, list) else 1
            wait_s = 0.0
        room.set()
    ended.set()
    deadline = time.monotonic() + LONGEST_LINGER * linger_s
    remaining = 0
    while True:  # what was on its way when the end was asked for is not thrown away
        try:
            item = inbox.get(timeout=max(0.0, min(linger_s, deadline - time.monotonic())))
        except Empty:
            break
        if item is not None:
            handle(item)
        if time.monotonic() >= deadline:
            remaining = inbox.qsize()
            break
    for _ in range(remaining):
        item = inbox.get_nowait()
        if item is not None:
            handle(item)
    publish(node.on_stop(clock.now_ns()))
