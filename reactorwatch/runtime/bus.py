"""What a node asks of a bus, and a bus within one process that gives it.

The nodes know only the protocol. The real bus is `bus_zenoh`; the one here delivers within the process, in the
order of publication, so that a whole chain of nodes can be tested without a network.
"""

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Protocol

from google.protobuf.message import Message

from reactorwatch.contract.codec import Encoded, encode_message
from reactorwatch.contract.keys import matches
from reactorwatch.runtime.delivery.reorder_buffer import Gap

MOST_GATHERED = 2000
"""Messages that are handed over together."""


class Request(Protocol):
    """A question that arrived at a queryable."""

    @property
    def question(self) -> Encoded:
        """The key asked at, and the payload."""

    def reply(self, message: Message) -> None:
        """Answer it; once."""

    def leave(self) -> None:
        """Leave the answer to others; instead of `reply`."""


class Bus(Protocol):
    """Publish and subscribe, ask and answer, and know who is alive."""

    def publish(self, message: Encoded) -> None:
        """Send bytes out on their key."""

    def subscribe(
        self,
        key_expression: str,
        handler: Callable[[Encoded], None],
        *,
        on_gap: Callable[[Gap], None] | None = None,
        history_s: float = 0.0,
        on_told: Callable[[], None] | None = None,
    ) -> None:
        """Call the handler, from a thread of the bus, with everything published on matching keys.

        What one bus publishes of one kind of one plant comes in the order of its publication, if the expression is of
        whole kinds (it ends in `/**`); on each key it always does.

        Args:
            key_expression: the keys.
            handler: gets the messages.
            on_gap: gets told, from a thread of the bus, what was published and never came.
            history_s: what was published up to this many seconds before comes first, as far as publishers remember it;
                `inf`: all that they remember, 0: nothing.
            on_told: called, from a thread of the bus and between the messages, when that has all come.
        """

    def gather(
        self,
        key_expression: str,
        handler: Callable[[list[Encoded]], None],
        *,
        on_gap: Callable[[Gap], None] | None = None,
        history_s: float = 0.0,
        on_told: Callable[[], None] | None = None,
    ) -> None:
        """As `subscribe`, of as many messages at a time as have come, up to about `MOST_GATHERED`."""

    @property
    def has_router(self) -> bool:
        """Whether a router is connected, without which a client reaches nobody, and sees nobody alive."""

    def recall(self, key_expression: str) -> list[Encoded]:
        """What was published on the keys of whole streams lately and is still remembered, in its order."""

    def answer(self, key_expression: str, handler: Callable[[Request], None]) -> None:
        """Call the handler, from a thread of the bus, with every question on matching keys."""

    def ask(self, question: Encoded, timeout_s: float) -> list[Encoded]:
        """All answers to a question that come within the time."""

    def announce(self, key: str) -> None:
        """Show a liveliness token until it is withdrawn, or this bus is closed, by whatever means."""

    def withdraw(self, key: str) -> None:
        """Show a token no longer that was announced here."""

    def watch_alive(self, key_expression: str, handler: Callable[[str, bool], None]) -> None:
        """Call the handler with (key, True) for tokens that are there or appear, (key, False) when they go."""

    def close(self) -> None:
        """Send what is still to be sent, and leave."""


@dataclass(frozen=True)
class MemoryRequest:
    """A question within the process, and where its answers are gathered."""

    question: Encoded
    answers: SimpleQueue[Encoded | None]

    def reply(self, message: Message) -> None:
        """Answer it."""
        self.answers.put(Encoded(self.question.key, *encode_message(message)))

    def leave(self) -> None:
        """See `Request`."""
        self.answers.put(None)


@dataclass
class Exchange:
    """What the memory buses of one process share."""

    subscriptions: list[tuple[object, str, Callable[[Encoded], None]]] = field(default_factory=list)
    answerers: list[tuple[object, str, Callable[[Request], None]]] = field(default_factory=list)
    tokens: list[tuple[object, str]] = field(default_factory=list)
    watchers: list[tuple[object, str, Callable[[str, bool], None]]] = field(default_factory=list)
    lock: threading.RLock = field(default_factory=threading.RLock)


class MemoryBus:
    """A bus within one process: every bus on the same exchange hears the others."""

    def __init__(self, exchange: Exchange) -> None:
        self._exchange = exchange

    def publish(self, message: Encoded) -> None:
        """See `Bus`; returns when every handler has returned, and holds nothing that they might wait for."""
        with self._exchange.lock:
            subscriptions = list(self._exchange.subscriptions)
        for _, expression, handler in subscriptions:
            if matches(expression, message.key):
                handler(message)

    def subscribe(
        self,
        key_expression: str,
        handler: Callable[[Encoded], None],
        *,
        on_gap: Callable[[Gap], None] | None = None,
        history_s: float = 0.0,
        on_told: Callable[[], None] | None = None,
    ) -> None:
        """See `Bus`; nothing is lost here, and nothing remembered."""
        with self._exchange.lock:
            self._exchange.subscriptions.append((self, key_expression, handler))
        if on_told is not None:
            on_told()

    def gather(
        self,
        key_expression: str,
        handler: Callable[[list[Encoded]], None],
        *,
        on_gap: Callable[[Gap], None] | None = None,
        history_s: float = 0.0,
        on_told: Callable[[], None] | None = None,
    ) -> None:
        """See `Bus`; here they come one by one."""
        self.subscribe(
            key_expression, lambda message: handler([message]), on_gap=on_gap, history_s=history_s, on_told=on_told
        )

    @property
    def has_router(self) -> bool:
        """See `Bus`; here there is always the exchange."""
        return True

    def recall(self, key_expression: str) -> list[Encoded]:
        """See `Bus`; here nothing is remembered."""
        return []

    def answer(self, key_expression: str, handler: Callable[[Request], None]) -> None:
        """See `Bus`."""
        with self._exchange.lock:
            self._exchange.answerers.append((self, key_expression, handler))

    def ask(self, question: Encoded, timeout_s: float) -> list[Encoded]:
        """See `Bus`; returns as soon as all have answered, or left it to others, who listen there."""
        answers: SimpleQueue[Encoded | None] = SimpleQueue()
        with self._exchange.lock:
            answerers = list(self._exchange.answerers)
        handlers = [handler for _, expression, handler in answerers if matches(expression, question.key)]
        until = time.monotonic() + timeout_s
        for handler in handlers:
            handler(MemoryRequest(question, answers))
        found: list[Encoded | None] = []
        with contextlib.suppress(Empty):
            while len(found) < len(handlers):
                found.append(answers.get(timeout=max(0.0, until - time.monotonic())))
        return [answer for answer in found if answer is not None]

    def announce(self, key: str) -> None:
        """See `Bus`."""
        with self._exchange.lock:
            self._exchange.tokens.append((self, key))
            self._tell(key, alive=True)

    def withdraw(self, key: str) -> None:
        """See `Bus`."""
        with self._exchange.lock:
            self._exchange.tokens.remove((self, key))
            self._tell(key, alive=False)

    def watch_alive(self, key_expression: str, handler: Callable[[str, bool], None]) -> None:
        """See `Bus`."""
        with self._exchange.lock:
            self._exchange.watchers.append((self, key_expression, handler))
            for _, key in self._exchange.tokens:
                if matches(key_expression, key):
                    handler(key, True)

    def close(self) -> None:
        """See `Bus`."""
        exchange = self._exchange
        with exchange.lock:
            exchange.subscriptions[:] = [entry for entry in exchange.subscriptions if entry[0] is not self]
            exchange.answerers[:] = [entry for entry in exchange.answerers if entry[0] is not self]
            exchange.watchers[:] = [entry for entry in exchange.watchers if entry[0] is not self]
            gone = [key for owner, key in exchange.tokens if owner is self]
            exchange.tokens[:] = [entry for entry in exchange.tokens if entry[0] is not self]
            for key in gone:
                self._tell(key, alive=False)

    def _tell(self, key: str, *, alive: bool) -> None:
        for _, expression, handler in list(self._exchange.watchers):
            if matches(expression, key):
                handler(key, alive)
