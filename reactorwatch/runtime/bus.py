"""Protocols of the bus, which `bus_zenoh` implements, and of a node as the event loop drives it."""

from collections.abc import Callable
from typing import Protocol, TypedDict, Unpack

from google.protobuf.message import Message

from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import CommandReply
from reactorwatch.runtime.reorder_buffer import Gap

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


class SubscribeOptions(TypedDict, total=False):
    """Options of a subscription.

    Attributes:
        on_gap: called, from a thread of the bus, with messages that were published and never arrived.
        history_s: age of the oldest earlier publication to receive first, as far as publishers cache it; `inf`: all
            that they cache, 0 (the default): none.
        on_history_end: called, from a thread of the bus and between the messages, when the earlier publications have
            all been handed over.
        late_rows: messages of each signal up to which one that was given up, and arrives after all, is handed over; by
            default any is. A monitor takes older samples for those of a plant that was restarted.
    """

    on_gap: Callable[[Gap], None] | None
    history_s: float
    on_history_end: Callable[[], None] | None
    late_rows: float


class Bus(Protocol):
    """Publish and subscribe, query and reply, and liveliness tokens."""

    def publish(self, message: Encoded) -> None:
        """Publish bytes on their key."""

    def subscribe(
        self, key_expression: str, handler: Callable[[Encoded], None], **options: Unpack[SubscribeOptions]
    ) -> None:
        """Call the handler, from a thread of the bus, with each message published on matching keys.

        Messages of one publisher, kind and plant arrive in the order of publication if the expression matches whole
        kinds (it ends in `/**`); messages on one key always do.
        """

    def subscribe_batched(
        self, key_expression: str, handler: Callable[[list[Encoded]], None], **options: Unpack[SubscribeOptions]
    ) -> None:
        """`subscribe` with a handler that takes all messages that have arrived, up to about `MAX_BATCH` at a time."""

    def flush_deliveries(self) -> None:
        """Hand over all messages that wait for missing ones before them, with gaps between them."""

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

    def query_tokens(self, key_expression: str) -> list[str]:
        """Liveliness tokens that exist now."""

    def subscribe_liveliness(self, key_expression: str, handler: Callable[[str, bool], None]) -> None:
        """Call the handler with (key, True) for tokens that exist or appear, (key, False) when they disappear."""

    def close(self) -> None:
        """Send all queued messages and disconnect."""


class Node(Protocol):
    """A core, or a core with its files; the default answers are those of a node without subscriptions and commands."""

    def on_message(self, message: Encoded, now_ns: int) -> list[Publication]:
        """Handle a message on a subscribed key."""
        return []

    def on_command(self, question: Encoded, now_ns: int) -> tuple[CommandReply | None, list[Publication]]:
        """Handle a command; the reply is None if another node answers it."""
        return CommandReply(accepted=False, text="this node has no commands"), []

    def on_tick(self, now_ns: int) -> list[Publication]:
        """Handle the deadline that `next_tick_ns` named."""

    def next_tick_ns(self) -> int:
        """Time of the next tick, by the clock that `now_ns` is read from."""

    @property
    def finished(self) -> bool:
        """True if the node has nothing left to do and the loop ends."""
        return False

    def on_stop(self, now_ns: int) -> list[Publication]:
        """Return the node's last publications; the loop ends."""
        return []
