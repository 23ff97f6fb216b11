"""The bus protocol, and its implementation within one process.

The nodes know only the protocol. The real bus is `bus_zenoh`. The one here delivers within the process, in the order of
publication, so that a whole chain of nodes can be tested without a network.
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

MAX_BATCH = 2000
"""Messages of one call of a batch handler."""


class Request(Protocol):
    """A query that arrived at a queryable."""

    @property
    def question(self) -> Encoded:
        """Key and payload of the query."""

    def reply(self, message: Message) -> None:
        """Answer the query; once."""

    def decline(self) -> None:
        """Leave the answer to other queryables; instead of `reply`."""


class Bus(Protocol):
    """Publish and subscribe, query and reply, and liveliness tokens."""

    def publish(self, message: Encoded) -> None:
        """Publish bytes on their key."""

    def subscribe(
        self,
        key_expression: str,
        handler: Callable[[Encoded], None],
        *,
        on_gap: Callable[[Gap], None] | None = None,
        history_s: float = 0.0,
        on_history_end: Callable[[], None] | None = None,
    ) -> None:
        """Call the handler, from a thread of the bus, with each message published on matching keys.

        Messages of one publisher, kind and plant arrive in the order of publication if the expression matches whole
        kinds (it ends in `/**`); messages on one key always do.

        Args:
            key_expression: the keys.
            handler: called with each message.
            on_gap: called, from a thread of the bus, with messages that were published and never arrived.
            history_s: age of the oldest earlier publication to receive first, as far as publishers cache it; `inf`: all
                that they cache, 0: none.
            on_history_end: called, from a thread of the bus and between the messages, when the earlier publications
                have all been handed over.
        """

    def subscribe_batched(
        self,
        key_expression: str,
        handler: Callable[[list[Encoded]], None],
        *,
        on_gap: Callable[[Gap], None] | None = None,
        history_s: float = 0.0,
        on_history_end: Callable[[], None] | None = None,
    ) -> None:
        """`subscribe` with a handler that takes all messages that have arrived, up to about `MAX_BATCH` at a time."""

    @property
    def has_router(self) -> bool:
        """True if a router is connected; without one, a client reaches no other process and sees no token."""

    def query_history(self, key_expression: str) -> list[Encoded]:
        """Recent messages on the keys of whole streams, from publishers' caches, in the order of publication."""

    def declare_queryable(self, key_expression: str, handler: Callable[[Request], None]) -> None:
        """Call the handler, from a thread of the bus, with each query on matching keys."""

    def query(self, question: Encoded, timeout_s: float) -> list[Encoded]:
        """Replies to a query that arrive within the time."""

    def declare_token(self, key: str) -> None:
        """Show a liveliness token until it is undeclared or this bus is closed, by whatever means."""

    def undeclare_token(self, key: str) -> None:
        """Remove a token that was declared here."""

    def subscribe_liveliness(self, key_expression: str, handler: Callable[[str, bool], None]) -> None:
        """Call the handler with (key, True) for tokens that exist or appear, (key, False) when they disappear."""

    def close(self) -> None:
        """Send all queued messages and disconnect."""


@dataclass(frozen=True)
class MemoryRequest:
    """A query within the process, and the queue of its replies."""

    question: Encoded
    answers: SimpleQueue[Encoded | None]

    def reply(self, message: Message) -> None:
        """See `Request`."""
        self.answers.put(Encoded(self.question.key, *encode_message(message)))

    def decline(self) -> None:
        """See `Request`."""
        self.answers.put(None)


@dataclass
class Exchange:
    """State shared by the memory buses of one process."""

    subscriptions: list[tuple[object, str, Callable[[Encoded], None]]] = field(default_factory=list)
    queryables: list[tuple[object, str, Callable[[Request], None]]] = field(default_factory=list)
    tokens: list[tuple[object, str]] = field(default_factory=list)
    watchers: list[tuple[object, str, Callable[[str, bool], None]]] = field(default_factory=list)
    lock: threading.RLock = field(default_factory=threading.RLock)


class MemoryBus:
    """A bus within one process, connected to every other bus on the same exchange."""

    def __init__(self, exchange: Exchange) -> None:
        self._exchange = exchange

    def publish(self, message: Encoded) -> None:
        """See `Bus`; returns when every handler has returned, and holds no lock while they run."""
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
        on_history_end: Callable[[], None] | None = None,
    ) -> None:
        """See `Bus`; nothing is lost here, and nothing cached."""
        with self._exchange.lock:
            self._exchange.subscriptions.append((self, key_expression, handler))
        if on_history_end is not None:
            on_history_end()

    def subscribe_batched(
        self,
        key_expression: str,
        handler: Callable[[list[Encoded]], None],
        *,
        on_gap: Callable[[Gap], None] | None = None,
        history_s: float = 0.0,
        on_history_end: Callable[[], None] | None = None,
    ) -> None:
        """See `Bus`; here each batch is one message."""
        self.subscribe(
            key_expression,
            lambda message: handler([message]),
            on_gap=on_gap,
            history_s=history_s,
            on_history_end=on_history_end,
        )

    @property
    def has_router(self) -> bool:
        """See `Bus`; the exchange is always there."""
        return True

    def query_history(self, key_expression: str) -> list[Encoded]:
        """See `Bus`; here nothing is cached."""
        return []

    def declare_queryable(self, key_expression: str, handler: Callable[[Request], None]) -> None:
        """See `Bus`."""
        with self._exchange.lock:
            self._exchange.queryables.append((self, key_expression, handler))

    def query(self, question: Encoded, timeout_s: float) -> list[Encoded]:
        """See `Bus`; returns as soon as every matching queryable has replied or declined."""
        answers: SimpleQueue[Encoded | None] = SimpleQueue()
        with self._exchange.lock:
            queryables = list(self._exchange.queryables)
        handlers = [handler for _, expression, handler in queryables if matches(expression, question.key)]
        until = time.monotonic() + timeout_s
        for handler in handlers:
            handler(MemoryRequest(question, answers))
        replies: list[Encoded | None] = []
        with contextlib.suppress(Empty):
            while len(replies) < len(handlers):
                replies.append(answers.get(timeout=max(0.0, until - time.monotonic())))
        return [answer for answer in replies if answer is not None]

    def declare_token(self, key: str) -> None:
        """See `Bus`."""
        with self._exchange.lock:
            self._exchange.tokens.append((self, key))
            self._notify(key, alive=True)

    def undeclare_token(self, key: str) -> None:
        """See `Bus`."""
        with self._exchange.lock:
            self._exchange.tokens.remove((self, key))
            self._notify(key, alive=False)

    def subscribe_liveliness(self, key_expression: str, handler: Callable[[str, bool], None]) -> None:
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
            exchange.queryables[:] = [entry for entry in exchange.queryables if entry[0] is not self]
            exchange.watchers[:] = [entry for entry in exchange.watchers if entry[0] is not self]
            gone = [key for owner, key in exchange.tokens if owner is self]
            exchange.tokens[:] = [entry for entry in exchange.tokens if entry[0] is not self]
            for key in gone:
                self._notify(key, alive=False)

    def _notify(self, key: str, *, alive: bool) -> None:
        for _, expression, handler in list(self._exchange.watchers):
            if matches(expression, key):
                handler(key, alive)
