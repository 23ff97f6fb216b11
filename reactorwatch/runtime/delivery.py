"""Ordered delivery of a subscription's messages; a thread gives up those that are missing too long.

Publishers number their messages in streams, groups of keys. A subscriber drops a number that it has already seen as a
repetition. So numbers must be counted among messages that only one role may publish: otherwise the holder of another
role's certificate could publish on its own keys with the publisher's name and next numbers, and have the publisher's
messages dropped. The access rules (`acl`) define which role publishes on a key; a stream is all of one kind of one
plant that one role may publish.
"""

import threading
import time
from collections.abc import Callable, Iterable
from functools import lru_cache
from itertools import islice
from math import inf
from typing import NamedTuple

from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.acl import ROLES, Role
from reactorwatch.runtime.reorder_buffer import Gap, ReorderBuffer

QUERY_ALL_INTERVAL_NS = 60_000_000_000
"""Shortest time between two queries for all that is cached of a stream: thousands of messages a key."""


class SequencedMessage(NamedTuple):
    """A message with its publisher's numbering.

    Attributes:
        publisher: random number that the publisher drew when it started.
        number: sequence number in the stream.
        message: the message; `received_ns` is its time of arrival.
    """

    publisher: int
    number: int
    message: Encoded

    @property
    def stream(self) -> str:
        """The stream that the number counts."""
        return stream_of(self.message.key)


class Delivery:
    """Ordered delivery from a subscription to its handler; may be called from any thread.

    Nothing is delivered before `start`.

    Zenoh recovers messages missing on each key; but on a key that it has just subscribed to it was seen to lose some
    without noticing, and it leaves out what was published on a new key before the first message that arrives. So before
    anything is given up, and before a stream starts with another number than 0, its publishers are queried.

    Args:
        handler: called with the messages, as many at a time as can be delivered.
        on_gap: called with messages that never arrived.
        query_stream: returns the messages published in a stream in the last so many seconds, from publishers' caches;
            infinite: all that are there.
        late_rows: see `SubscribeOptions`.
    """

    def __init__(
        self,
        handler: Callable[[list[Encoded]], None],
        on_gap: Callable[[Gap], None],
        query_stream: Callable[[str, float], Iterable[SequencedMessage]] = lambda _stream, _since_s: (),
        late_rows: float = inf,
    ) -> None:
        self._handler = handler
        self._on_gap = on_gap
        self._query_stream = query_stream
        self._buffer: ReorderBuffer[Encoded] = ReorderBuffer(
            await_history=True,
            size=lambda item: len(item.payload),
            start_ns=time.monotonic_ns(),
            late_rows=late_rows,
        )
        self._changed = threading.Condition()
        self._closed = threading.Event()
        self._query_all_ns: dict[str, int] = {}  # time from which all of a stream may be queried again
        self._thread = threading.Thread(target=self._give_up_when_due, name="delivery", daemon=True)
        self._thread.start()

    def receive(self, arrived: Iterable[tuple[int, int, Encoded]]) -> None:
        """Add messages, each as a `SequencedMessage`, and deliver those that are in order."""
        with self._changed:
            buffer = self._buffer
            previous_due_ns, now_ns = buffer.due_ns(), time.monotonic_ns()
            accept_next, released = buffer.accept_next, list[Encoded | Gap]()
            for publisher, number, message in arrived:
                key = message.key
                if accept_next(publisher, key, number, now_ns):
                    released.append(message)
                else:
                    released += buffer.push(publisher, stream_of(key), key, number, message, now_ns)
            self._deliver(released)
            if buffer.due_ns() != previous_due_ns:
                self._changed.notify()

    def set_last(self, last: SequencedMessage, *, is_recent: bool = False) -> None:
        """Before `start`: record a publisher's last message on a key, and whether the history includes it."""
        with self._changed:
            key, number = last.message.key, last.number
            self._buffer.set_last(last.publisher, last.stream, key, number, is_recent=is_recent)

    def add_history(self, earlier: SequencedMessage) -> bool:
        """Before `start`: add a message that was published before the subscription; True if it is new."""
        with self._changed:
            return self._buffer.add_history(
                earlier.publisher, earlier.stream, earlier.message.key, earlier.number, earlier.message
            )

    def history_complete(self) -> bool:
        """Before `start`: see `ReorderBuffer.history_complete`."""
        with self._changed:
            return self._buffer.history_complete()

    def start(self, on_history_end: Callable[[], None] | None = None) -> None:
        """Deliver the history and, after it, live messages.

        Args:
            on_history_end: called between the two.
        """
        with self._changed:
            self._deliver(self._buffer.end_history(time.monotonic_ns()))
            if on_history_end is not None:
                on_history_end()
            self._changed.notify()

    def close(self) -> None:
        """Deliver all held messages, with gaps between them, and end the thread."""
        with self._changed:
            self._closed.set()
            self._changed.notify()
        self._thread.join()
        self.flush_deliveries()

    def flush_deliveries(self) -> None:
        """Deliver all held messages, with gaps between them."""
        with self._changed:
            while (due_ns := self._buffer.due_ns()) is not None:
                self._deliver(self._buffer.release_overdue(due_ns))

    def _deliver(self, items: Iterable[Encoded | Gap]) -> None:
        batch: list[Encoded] = []
        for item in items:
            if isinstance(item, Gap):
                if batch:
                    self._handler(batch)
                    batch = []
                self._on_gap(item._replace(noticed_ns=time.time_ns()))
            else:
                batch.append(item)
        if batch:
            self._handler(batch)

    def _give_up_when_due(self) -> None:
        while True:
            with self._changed:
                now_ns, due_ns = time.monotonic_ns(), self._buffer.due_ns()
                while not self._closed.is_set() and (due_ns is None or due_ns > now_ns):
                    self._changed.wait(None if due_ns is None else (due_ns - now_ns) / 1e9)
                    now_ns, due_ns = time.monotonic_ns(), self._buffer.due_ns()
                if self._closed.is_set():
                    return
                self._deliver(self._buffer.release_overdue(now_ns, only_queried=True))
                overdue = self._buffer.take_overdue(now_ns)
            # with more, the network broke down, and the queries would never end
            for stream, after_ns in islice(overdue.items(), 100):
                if self._closed.is_set():
                    return
                self._recover(stream, (now_ns - after_ns) / 1e9)

    def _recover(self, stream: str, since_s: float) -> None:
        """Query what is missing in a stream.

        The replies may begin behind the gap: messages that waited long on their way, because this process was too busy
        to take them, were published longer ago than their arrival tells. Then all that is cached is queried, at most
        once in `QUERY_ALL_INTERVAL_NS`: a cache that is too small for the gap answers in vain, and a made-up publisher
        could ask for it.
        """
        replies = list(self._query_stream(stream, since_s))
        self.receive(replies)
        oldest: dict[int, int] = {}
        for reply in replies:
            oldest[reply.publisher] = min(reply.number, oldest.get(reply.publisher, reply.number))
        now_ns = time.monotonic_ns()
        with self._changed:
            is_cut_off = self._buffer.is_missing_before(stream, oldest)
        if self._closed.is_set() or not is_cut_off or now_ns < self._query_all_ns.get(stream, now_ns):
            return
        self._query_all_ns = {name: due_ns for name, due_ns in self._query_all_ns.items() if due_ns > now_ns}
        self._query_all_ns[stream] = now_ns + QUERY_ALL_INTERVAL_NS
        self.receive(self._query_stream(stream, inf))


STREAM_PARTS = 3
"""Parts of a key that a stream has in common: root, plant and kind."""
MAX_CACHED = 1000
"""Names below a plant whose role is cached: all plants have the same ones, and made-up names evict each other."""

_KEY_SPACES = sorted(
    ((expression, role) for role in ROLES for expression in role.key_space),
    key=lambda item: item[0].count("/"),
    reverse=True,
)
"""Narrowest first: the monitor's expression also matches the recorder's own alarms."""


@lru_cache(maxsize=MAX_CACHED)
def role_of_key(name: str) -> Role | None:
    """Role that may publish on a key; None if no role may.

    Args:
        name: the key below its plant.

    >>> [role_of_key(name).name for name in ("alarm/ewma/T", "alarm/recording/disk", "health/plant")]
    ['monitor', 'recorder', 'plant']
    >>> role_of_key("health/somebody") is None
    True
    """
    return next((role for expression, role in _KEY_SPACES if keys.matches(expression, name)), None)


def stream_of(key: str) -> str:
    """Stream of a key: root, plant and kind, and the role where it does not publish all of the kind.

    >>> stream_of("reactor/cstr/chart/ewma/T"), stream_of("reactor/cstr/alarm/recording/disk")
    ('reactor/cstr/chart', 'reactor/cstr/alarm/@recorder')
    """
    parts = key.split("/")
    kind = "/".join(parts[:STREAM_PARTS])
    if parts[0] != keys.ROOT or len(parts) < STREAM_PARTS:
        return kind
    role = role_of_key("/".join(parts[2:]))
    if role is None:
        return f"{kind}/@none"
    return kind if f"{parts[2]}/**" in role.key_space else f"{kind}/@{role.name}"


def keys_of(stream: str) -> str:
    """Key expression that matches all keys of a stream, and perhaps those of other roles.

    >>> keys_of("reactor/cstr/alarm/@recorder")
    'reactor/cstr/alarm/**'
    """
    return "/".join((*stream.split("/")[:STREAM_PARTS], "**"))
