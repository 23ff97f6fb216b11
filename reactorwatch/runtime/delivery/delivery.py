"""Handing on what comes from a bus in the order of its publication; what waits too long is given up by a thread."""

import threading
import time
from collections.abc import Callable, Iterable
from itertools import islice
from typing import NamedTuple

from reactorwatch.contract.codec import Encoded
from reactorwatch.runtime.delivery.reorder_buffer import Gap, InOrder
from reactorwatch.runtime.delivery.streams import stream_of

MOST_ASKED_FOR = 100
"""Streams whose publishers are asked again at once: of more than that something is missing when a network broke down,
and then there would be no end of it."""


class Numbered(NamedTuple):
    """A message as its publisher numbered it.

    Attributes:
        publisher: who.
        number: in its stream.
        message: what; `received_ns` is when it came.
    """

    publisher: int
    number: int
    message: Encoded

    @property
    def stream(self) -> str:
        """What was counted."""
        return stream_of(self.message.key)


class Delivery:
    """Between a subscription and its handler; may be called from any thread.

    Nothing is handed on until `begin`.

    Zenoh recovers what is missing of each key; but of a key that it has just begun to hear it was seen to leave out
    some, and not to notice. So before anything is given up, its publisher is asked for it once more.

    Args:
        handler: gets the messages that go on, as many at a time as there are.
        on_gap: gets told what never came.
        ask: what was published in a stream in the last so many seconds, as its publishers remember it.
    """

    def __init__(
        self,
        handler: Callable[[list[Encoded]], None],
        on_gap: Callable[[Gap], None],
        ask: Callable[[str, float], Iterable[Numbered]] = lambda _stream, _since_s: (),
    ) -> None:
        self._handler = handler
        self._on_gap = on_gap
        self._ask = ask
        self._order: InOrder[Encoded] = InOrder(gathering=True, size=lambda item: len(item.payload))
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._give_up_when_due, name="delivery", daemon=True)
        self._thread.start()

    def receive(self, came: Iterable[tuple[int, int, Encoded]]) -> None:
        """Take messages in, each `Numbered`, and hand on what may go on."""
        with self._changed:
            order = self._order
            waited, now_ns = order.due_ns(), time.monotonic_ns()
            takes_next, going = order.takes_next, list[Encoded | Gap]()
            for publisher, number, message in came:
                key = message.key
                if takes_next(publisher, key, number, now_ns):
                    going.append(message)
                else:
                    going += order.arrive(publisher, stream_of(key), key, number, message, now_ns)
            self._hand_on(going)
            if order.due_ns() != waited:
                self._changed.notify()

    def tell_last(self, last: Numbered) -> None:
        """Before the beginning: what a publisher has published last on a key."""
        with self._changed:
            self._order.tell_last(last.publisher, last.stream, last.message.key, last.number)

    def tell(self, came: Numbered) -> None:
        """Before the beginning: what was published before and is wanted."""
        with self._changed:
            self._order.tell(came.publisher, came.stream, came.message.key, came.number, came.message)

    def is_told(self) -> bool:
        """Before the beginning: see `InOrder.is_told`."""
        with self._changed:
            return self._order.is_told()

    def begin(self, on_told: Callable[[], None] | None = None) -> None:
        """Hand on what has come until now, and from now on what comes.

        Args:
            on_told: called between the two.
        """
        with self._changed:
            self._hand_on(self._order.gathered(time.monotonic_ns()))
            if on_told is not None:
                on_told()
            self._changed.notify()

    def close(self) -> None:
        """Hand on what waits, whatever is missing, and end."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        while (due_ns := self._order.due_ns()) is not None:
            self._hand_on(self._order.overdue(due_ns))

    def _hand_on(self, items: Iterable[Encoded | Gap]) -> None:
        together: list[Encoded] = []
        for item in items:
            if isinstance(item, Gap):
                if together:
                    self._handler(together)
                    together = []
                self._on_gap(item._replace(noticed_ns=time.time_ns()))
            else:
                together.append(item)
        if together:
            self._handler(together)

    def _give_up_when_due(self) -> None:
        asked_ns = 0
        while True:
            with self._changed:
                now_ns, due_ns = time.monotonic_ns(), self._order.due_ns()
                while not self._closed and (due_ns is None or due_ns > now_ns):
                    self._changed.wait(None if due_ns is None else (due_ns - now_ns) / 1e9)
                    now_ns, due_ns = time.monotonic_ns(), self._order.due_ns()
                if self._closed:
                    return
                waiting = self._order.waiting(now_ns)
                if all(since_ns <= asked_ns for since_ns in waiting.values()):
                    self._hand_on(self._order.overdue(now_ns))
                    continue
                asked_ns = now_ns
            for stream, since_ns in islice(waiting.items(), MOST_ASKED_FOR):
                self.receive(list(self._ask(stream, (now_ns - since_ns) / 1e9)))
