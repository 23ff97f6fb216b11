"""State of one stream of numbered messages: see `reorder_buffer`.

A fleet has tens of thousands of streams, nearly all of which hold no message back. So the state that is needed only
while messages are held is a separate object.
"""

from dataclasses import dataclass, field
from typing import Generic, TypeVar

from reactorwatch.runtime.delivery.gap_tracker import GapTracker

Item = TypeVar("Item")

MAX_HELD = 1_000_000
MAX_HELD_BYTES = 256 << 20
"""Messages of a stream that may be held, and their payload; beyond either, missing messages are given up."""
MAX_LOST_RANGES = 100_000
"""Ranges of lost numbers of a stream that are remembered, so that a message in one can still be released."""
MAX_KEYS = 1000
"""Keys of a stream that are tracked."""


@dataclass(slots=True)
class HoldState(Generic[Item]):
    """State of a stream while messages are held back."""

    history: dict[int, Item] = field(default_factory=dict)  # published before the subscription, by number
    history_from: dict[str, int] = field(default_factory=dict)  # first number of the history, by key
    held: dict[int, tuple[int, Item]] = field(default_factory=dict)  # arrival time and message, by number
    held_bytes: int = 0
    newest: int = 0
    due_ns: int | None = None  # when to check whether to hold no longer; None: nothing is held
    after_ns: int = 0  # when the last message before the first held one arrived
    queried_ns: int = 0  # when publishers were last queried for what is missing
    recovered_ns: int = 0  # when a missing message arrived last, or the first one was found missing
    reached: dict[str, int] = field(default_factory=dict)  # newest number by key, unless it is below the expected one

    def add_history(self, key: str, number: int, item: Item) -> None:
        """Store a message published before the subscription, if there is room."""
        if len(self.history) < MAX_HELD:
            self.history[number] = item
            self.history_from[key] = min(self.history_from.get(key, number), number)

    @property
    def is_full(self) -> bool:
        """True if more is held than there is room for."""
        return len(self.held) > MAX_HELD or self.held_bytes > MAX_HELD_BYTES

    @property
    def first_arrival_ns(self) -> int:
        """Time when the first of the held messages arrived; 0 if none is held."""
        return min((arrival_ns for arrival_ns, _ in self.held.values()), default=0)

    @property
    def is_queried(self) -> bool:
        """True if publishers were queried after the first of the held messages arrived."""
        return self.first_arrival_ns <= self.queried_ns

    @property
    def complete_from(self) -> int:
        """First number from which the history holds every key: publishers cache fewer messages of some keys."""
        return max(self.history_from.values(), default=0)


@dataclass(slots=True, kw_only=True)
class StreamState(GapTracker, Generic[Item]):
    """Position in a stream; its gaps are given up, and a message in one is released at once."""

    max_gaps = MAX_LOST_RANGES

    publisher: int
    stream: str
    first: int = -1  # number of the first message released
    last_before: int = -1  # last number published before the subscription
    last_arrival_ns: int = 0
    keys: tuple[str, ...] = ()
    hold: HoldState[Item] | None = None

    @property
    def name(self) -> tuple[int, str]:
        """Publisher and stream."""
        return self.publisher, self.stream

    def record_key(self, key: str, number: int) -> None:
        """Record that a key has reached a number."""
        if key not in self.keys:
            if len(self.keys) >= MAX_KEYS:
                return
            self.keys = (*self.keys, key)
        if self.expected is None or number >= self.expected:
            reached = self.hold_state().reached
            reached[key] = max(reached.get(key, number), number)

    @property
    def reached_by_all(self) -> int:
        """Number that every key has reached; -1 if a key has not passed the expected one."""
        hold = self.hold_state()
        return min((hold.reached.get(key, -1) for key in self.keys), default=hold.newest)

    @property
    def is_orphan(self) -> bool:
        """True if a single message arrived, and its predecessor is unknown."""
        return self.hold is None and self.last_before < 0 < self.first and self.expected == self.first + 1

    def hold_state(self) -> HoldState[Item]:
        """The state for held messages, made if there is none."""
        if self.hold is None:
            self.hold = HoldState()
        return self.hold

    def drop_hold_state(self) -> None:
        """Drop the state for held messages if none is held."""
        hold = self.hold
        if hold is None or hold.held or hold.history or self.expected is None:
            return
        hold.reached = {key: number for key, number in hold.reached.items() if number >= self.expected}
        if not hold.reached:
            self.hold = None

    def advance(self, number: int, time_ns: int = 0) -> int:
        """Mark all messages up to a number as released or lost; returns how many are lost."""
        if self.expected is None:
            self.first = number
        return GapTracker.advance(self, number, time_ns)
