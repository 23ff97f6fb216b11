"""A node as the event loop drives it, with the answers of one that subscribes to nothing and has no commands."""

from typing import Protocol

from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import CommandReply


class Node(Protocol):
    """A core, or a core with its files, as the loop drives it."""

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
