"""A bus within one process, in the order of publication: a chain of nodes runs on it without a network."""

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from typing import Unpack

from google.protobuf.message import Message

from reactorwatch.contract.codec import Encoded, encode_message
from reactorwatch.contract.keys import matches
from reactorwatch.runtime.bus import Request, SubscribeOptions


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
        self.held: list[Encoded] = []
        """Messages that wait for missing ones."""

    def publish(self, message: Encoded) -> None:
        """See `Bus`; returns when every handler has returned, and holds no lock while they run."""
        with self._exchange.lock:
            subscriptions = list(self._exchange.subscriptions)
        for _, expression, handler in subscriptions:
            if matches(expression, message.key):
                handler(message)

    def subscribe(
        self, key_expression: str, handler: Callable[[Encoded], None], **options: Unpack[SubscribeOptions]
    ) -> None:
        """See `Bus`; nothing is lost here, and nothing cached."""
        with self._exchange.lock:
            self._exchange.subscriptions.append((self, key_expression, handler))
        on_history_end = options.get("on_history_end")
        if on_history_end is not None:
            on_history_end()

    def subscribe_batched(
        self, key_expression: str, handler: Callable[[list[Encoded]], None], **options: Unpack[SubscribeOptions]
    ) -> None:
        """See `Bus`; here each batch is one message."""
        self.subscribe(key_expression, lambda message: handler([message]), **options)

    def flush_deliveries(self) -> None:
        """See `Bus`."""
        for message in self.held:
            self.publish(message)
        self.held.clear()

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

    def query_tokens(self, key_expression: str) -> list[str]:
        """See `Bus`."""
        with self._exchange.lock:
            return sorted(key for _, key in self._exchange.tokens if matches(key_expression, key))

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
