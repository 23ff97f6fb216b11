"""The event loop of every node: wait for a message, a command or a deadline, and hand it to the core.

The core returns what to publish and the time of its next tick. Only the loop reads the clock, waits for signals and
touches the bus. It also publishes a record of each command and its answer (`audit`). The bus calls handlers from its
own threads; they only put items into the inbox.
"""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from math import inf
from queue import Empty, SimpleQueue
from types import FrameType
from typing import TypeAlias, TypeVar

from reactorwatch.contract.codec import Encoded, Publication, encode
from reactorwatch.errors import is_passing
from reactorwatch.runtime.acl import audit
from reactorwatch.runtime.bus import MAX_BATCH, Bus, Node, Request
from reactorwatch.runtime.reorder_buffer import Gap

MAX_DRAIN_FACTOR = 10
"""Multiple of `drain_timeout_s` after which a node ends although messages still arrive."""
MAX_INBOX_MESSAGES = 100_000
MAX_INBOX_BYTES = 64 << 20  # of payload
"""Beyond either the bus's thread is blocked, and with it the publishers that are too fast for the node."""
POLL_S = 0.1  # a person does not notice it
_END = b"\0"  # no signal has this number
BATCH = 256  # messages after which no further item is handled before the loop reads the clock again


_Handler: TypeAlias = Callable[..., list[Publication]]
_Item: TypeAlias = tuple[_Handler, tuple[object, ...], int, int]
"""A function whose result is published, its arguments before the time, and the messages and payload bytes in these.

A plain tuple is made in an eighth of the time of a named one, and the loop takes one a message."""


def _no_publications(_now_ns: int) -> list[Publication]:
    return []


class _Inbox:
    """Bounded queue between the bus's threads and the loop; messages wait for room in it.

    While the loop waits for the bus to take a publication, it makes no room. The bus may take it only when a thread
    that waits for room has received another message, so after `POLL_S` messages wait no longer for that publication.

    Attributes:
        publication: number of the publication that the loop waits for, from 1; 0 if it waits for none.
    """

    def __init__(self, stop: "StopSignal") -> None:
        self._items: SimpleQueue[_Item] = SimpleQueue()
        self._lock, self._room = threading.Lock(), threading.Event()
        self._messages = self._bytes = 0
        self._stop, self._closed, self._was_full = stop, False, False
        self.publication = self._blocked = 0
        stop.call_on_set(lambda: self.put(_no_publications))
        stop.call_on_set(self._room.set)

    def put(self, function: _Handler, arguments: tuple[object, ...] = (), messages: int = 0, payload: int = 0) -> None:
        """Append a function to call; from threads of the bus. One with messages blocks until there is room."""
        if messages:
            while self._is_full and not (self._stop.is_set or self._closed or self._is_blocked):
                self._was_full, publication = True, self.publication
                self._room.clear()
                if not self._room.wait(POLL_S) and publication == self.publication:
                    self._blocked = publication
            self._count(messages, payload)
        self._items.put((function, arguments, messages, payload))

    def get(self, timeout_s: float) -> _Item | None:
        """Take the next item; None if none arrived in time."""
        try:
            item = self._items.get(timeout=timeout_s) if timeout_s > 0 else self._items.get_nowait()
        except Empty:
            self._was_full = self._was_full and timeout_s <= 0
            return None
        if item[2]:
            self._count(-item[2], -item[3])
        return item

    def admit(self) -> None:
        """Let blocked publishers check for room again."""
        self._room.set()

    def close(self) -> None:
        """Block no publisher any more."""
        self._closed = True

    def __len__(self) -> int:
        """Number of items."""
        return self._items.qsize()

    @property
    def has_backlog(self) -> bool:
        """True if messages wait here, or have waited for room since the loop last waited for messages."""
        return self._messages > 0 or self._was_full

    @property
    def _is_blocked(self) -> bool:
        """True if the loop has waited for one publication for `POLL_S`."""
        return 0 < self._blocked == self.publication

    @property
    def _is_full(self) -> bool:
        return self._messages >= MAX_INBOX_MESSAGES or self._bytes >= MAX_INBOX_BYTES

    def _count(self, messages: int, payload: int) -> None:
        with self._lock:
            self._messages += messages
            self._bytes += payload


class StopSignal:
    """Flag set once, by a signal or another thread, that wakes a waiting loop.

    Attributes:
        interrupted: True if it was set by SIGINT (Ctrl-C).
    """

    def __init__(self) -> None:
        self.interrupted = False
        self._set = threading.Event()
        self._callbacks: list[Callable[[], None]] = []

    def set(self) -> None:
        """Ask the loop to end."""
        self._set.set()
        for callback in self._callbacks:
            callback()

    @property
    def is_set(self) -> bool:
        """True once the loop was asked to end."""
        return self._set.is_set()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the loop is asked to end, at most so long; returns True if it is."""
        return self._set.wait(timeout_s)

    def call_on_set(self, callback: Callable[[], None]) -> None:
        """Register a function that `set` calls."""
        self._callbacks.append(callback)


@contextlib.contextmanager
def stop_on_signals(*, is_supervisor: bool = False) -> Iterator[StopSignal]:
    """Stop signal that SIGINT (Ctrl-C) and SIGTERM set, while the context lasts, and SIGHUP in a terminal.

    SIGHUP is ignored without a terminal that could be closed, unless the process supervises others, and where it was
    ignored before, as under `nohup`.

    Python runs a handler in the main thread, between two of its instructions: while that thread may hold any lock, and
    only after a wait that began just before the signal has ended. So the handler does nothing. The interpreter writes
    the signal's number into a pipe at once (`signal.set_wakeup_fd`), and a thread that reads the pipe sets the stop.
    """
    stop = StopSignal()
    terminals = [number for number in range(3) if os.isatty(number)]
    stopping = {signal.SIGINT, signal.SIGTERM}
    if (is_supervisor or terminals or _has_terminal()) and signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
        stopping.add(signal.SIGHUP)
    source, sink = os.pipe()
    os.set_blocking(sink, False)

    def handler(_number: int, _frame: FrameType | None) -> None:
        pass

    def wake_on_request() -> None:
        while _END not in (numbers := os.read(source, 64)):
            if signal.SIGHUP in numbers:
                previous[signal.SIGHUP] = signal.SIG_IGN  # the shell sends a second one
                _leave_terminals(terminals)
            stop.interrupted = stop.interrupted or signal.SIGINT in numbers
            if stopping & set(numbers):
                stop.set()

    waker = threading.Thread(target=wake_on_request, name="stop", daemon=True)
    waker.start()
    previous = {number: signal.signal(number, handler) for number in stopping}
    if signal.SIGHUP not in stopping:
        previous[signal.SIGHUP] = signal.signal(signal.SIGHUP, signal.SIG_IGN)
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


def _has_terminal() -> bool:
    """True if the process has a controlling terminal, also with its streams redirected."""
    with contextlib.suppress(OSError):
        os.close(os.open("/dev/tty", os.O_RDWR | os.O_NOCTTY))
        return True
    return False


def _leave_terminals(streams: list[int]) -> None:
    """Redirect standard streams whose terminal was closed: each write to it would be an error."""
    null = os.open(os.devnull, os.O_RDWR)
    for stream in streams:
        if not os.isatty(stream):
            os.dup2(null, stream)
    os.close(null)


class EventLoop:
    """Runs a node until it is finished or asked to stop.

    Args:
        node: the node.
        bus: an open bus; it stays open.
        stop: ends the loop; items in the inbox by then are still handled.
        drain_timeout_s: once asked to stop, the loop runs on until nothing has arrived for this long, for at most
            `MAX_DRAIN_FACTOR` times as long.
        on_publish: called with each publication of the node, in the loop's thread, before it is sent.
        on_backlog: called before each tick with True if messages have arrived that the node has not handled.
    """

    def __init__(
        self,
        node: Node,
        bus: Bus,
        stop: StopSignal,
        *,
        drain_timeout_s: float = 0.0,
        on_publish: Callable[[Publication], None] | None = None,
        on_backlog: Callable[[bool], None] = lambda _has_backlog: None,
    ) -> None:
        self._node, self._bus, self._stop = node, bus, stop
        self._drain_timeout_s, self._on_publish, self._on_backlog = drain_timeout_s, on_publish, on_backlog
        self._clock = SteadyClock()
        self._inbox = _Inbox(stop)
        self._published = 0

    def subscribe(
        self,
        *key_expressions: str,
        history_s: float = 0.0,
        on_history_end: Callable[[], None] | None = None,
        on_gap: Callable[[Gap, int], list[Publication]] | None = None,
        on_batch: Callable[[list[Encoded], int], list[Publication]] | None = None,
        late_rows: float = inf,
    ) -> None:
        """Hand messages on these keys to `node.on_message`; to be called once.

        All handlers are called in the loop's thread, in the order of arrival.

        Args:
            key_expressions: the keys.
            history_s: age of the oldest earlier publication to receive, see `Bus.subscribe`.
            on_history_end: called when all earlier publications have been handled.
            on_gap: called with messages that were published and never arrived, and the time.
            on_batch: called instead of `node.on_message`, with messages that have arrived, up to `MAX_BATCH` at a
                time, and the time.
            late_rows: see `SubscribeOptions`.
        """

        def put_message(message: Encoded) -> None:
            self._inbox.put(self._node.on_message, (message,), 1, len(message.payload))

        def put_batch(handle: _Handler, messages: list[Encoded]) -> None:
            for start in range(0, len(messages), MAX_BATCH):  # a history comes at once: many thousands
                part = messages[start : start + MAX_BATCH]
                self._inbox.put(handle, (part,), len(part), sum([len(message.payload) for message in part]))

        def put_gap(handle: _Handler, gap: Gap) -> None:
            self._inbox.put(handle, (gap,), 1)

        def end_history(on_end: Callable[[], None], _now_ns: int) -> list[Publication]:
            on_end()
            return []

        subscribe = partial(self._bus.subscribe, handler=put_message)
        if on_batch is not None:
            subscribe = partial(self._bus.subscribe_batched, handler=partial(put_batch, on_batch))
        for expression in key_expressions:
            subscribe(
                expression,
                on_gap=on_gap and partial(put_gap, on_gap),
                history_s=history_s,
                on_history_end=on_history_end and partial(self._inbox.put, end_history, (on_history_end,)),
                late_rows=late_rows,
            )

    def call(self, function: Callable[[int], list[Publication]]) -> None:
        """Call a function with the time, in the loop's thread, when all that has arrived is handled; from any thread.

        What it returns is published.
        """
        self._inbox.put(function)

    def subscribe_liveliness(
        self, *key_expressions: str, on_token: Callable[[str, bool, int], list[Publication]]
    ) -> None:
        """Call `on_token` with a liveliness token, whether it appeared, and the time."""
        for expression in key_expressions:
            self._bus.subscribe_liveliness(expression, lambda key, is_alive: self._inbox.put(on_token, (key, is_alive)))

    def accept_commands(self, *key_expressions: str) -> None:
        """Hand commands on these keys to `node.on_command`; like messages they wait for room in the inbox."""

        def put_request(request: Request) -> None:
            self._inbox.put(self._answer, (request,), 1, len(request.question.payload))

        for expression in key_expressions:
            self._bus.declare_queryable(expression, put_request)

    def run(self) -> None:
        """Run to the end."""
        while not (self._stop.is_set or self._node.finished):
            self._run_once()
            self._inbox.admit()
        self._inbox.close()
        self._drain()
        self._bus.flush_deliveries()
        self._handle_rest()
        self._publish(self._node.on_stop(self._clock.now_ns()))

    def _run_once(self) -> None:
        """Tick if it is due; otherwise wait for items, and handle them up to that which completes `BATCH` messages."""
        wait_s = (self._node.next_tick_ns() - self._clock.now_ns()) / 1e9
        if wait_s <= 0:
            self._on_backlog(self._inbox.has_backlog)
            self._publish(self._node.on_tick(self._clock.now_ns()))
        handled = 0
        while handled < BATCH and (messages := self._handle_next(min(wait_s, 3600.0))):
            handled += messages
            wait_s = 0.0

    def _drain(self) -> None:
        """Handle messages that were on their way when the stop was requested."""
        left_s = MAX_DRAIN_FACTOR * self._drain_timeout_s
        deadline = time.monotonic() + left_s
        while left_s > 0 and self._handle_next(min(self._drain_timeout_s, left_s)):
            left_s = deadline - time.monotonic()
        self._handle_rest()

    def _handle_rest(self) -> None:
        """Handle what is in the inbox."""
        for _ in range(len(self._inbox)):
            self._handle_next(0.0)

    def _handle_next(self, timeout_s: float) -> int:
        """Handle the next item; returns the number of its messages, at least 1, or 0 if none arrived in time."""
        if (item := self._inbox.get(timeout_s)) is None:
            return 0
        function, arguments, messages, _ = item
        self._publish(function(*arguments, self._clock.now_ns()))
        return messages or 1

    def _answer(self, request: Request, now_ns: int) -> list[Publication]:
        reply, publications = self._node.on_command(request.question, now_ns)
        if reply is None:
            request.decline()
            return []
        request.reply(reply)
        record = audit(request.question, reply, self._clock.now_ns())
        return publications if record is None else [*publications, record]

    def _publish(self, publications: list[Publication]) -> None:
        for publication in publications:
            if self._on_publish is not None:
                self._on_publish(publication)
            self._published += 1
            self._inbox.publication = self._published
            self._bus.publish(encode(publication))
            self._inbox.publication = 0


class SteadyClock:
    """Clock of a loop, from any thread: the machine's clock, but it never runs backwards and never stops.

    If the machine's clock is set forward, this one follows at once. If it is set back, this one slews: it runs at 0.9
    times its speed until the machine's clock has caught up; a node that followed would be idle for as long as the clock
    was set back.

    Args:
        wall_ns: reads the machine's clock.
        monotonic_ns: reads a clock that cannot be set.
    """

    def __init__(
        self, wall_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._lock = threading.Lock()
        self._monotonic, self._now_ns = monotonic_ns(), wall_ns()

    def now_ns(self) -> int:
        """Nanoseconds since 1970-01-01 UTC."""
        with self._lock:
            monotonic = self._monotonic_ns()
            slewed_ns = self._now_ns + int(0.9 * (monotonic - self._monotonic))
            self._monotonic, self._now_ns = monotonic, max(self._wall_ns(), slewed_ns)
            return self._now_ns


Result = TypeVar("Result")


def retry(
    attempt: Callable[[], Result],
    wait: Callable[[float], bool],
    on_failure: Callable[[str, bool], object],
    passes: Callable[[BaseException], bool] = is_passing,
) -> Result | None:
    """Call a function until it raises no error that can pass: a full disk, a folder without rights, a taken address.

    Other errors are raised at once. The waits double from 0.1 s to 2 s.

    Args:
        attempt: the function.
        wait: waits for so many seconds; returns True, early, once a stop is requested.
        on_failure: called after each failure with its reason, and True if the failure before had another reason.
        passes: True for an error that can pass.

    Returns:
        The result of the function; None if a stop was requested first.
    """
    retry_s, before = 0.1, ""
    while not wait(0.0):
        try:
            return attempt()
        except Exception as error:
            if not passes(error):
                raise
            reason = describe(error)
        on_failure(reason, reason != before)
        before = reason
        if wait(retry_s):
            break
        retry_s = min(2 * retry_s, 2.0)
    return None


def describe(error: BaseException) -> str:
    """Reason of a failure in one line; an error of the system names its file."""
    if isinstance(error, OSError) and error.strerror is not None:
        return f"{error.filename}: {error.strerror}" if error.filename is not None else error.strerror
    return next(iter(str(error).splitlines()), type(error).__name__)
