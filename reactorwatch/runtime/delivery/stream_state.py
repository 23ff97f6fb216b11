"""What is remembered of a stream of numbered messages: see `in_order`.

There are tens of thousands of streams in a fleet, in nearly all of which nothing waits. So what is only wanted while
something does is kept apart.
"""

from dataclasses import dataclass, field
from typing import Generic, TypeVar

Item = TypeVar("Item")

MOST_HELD = 1_000_000
MOST_HELD_BYTES = 256 << 20
"""Messages of a stream that may wait, and their payload; with more, what is missing is given up."""
MOST_KEYS = 1000
"""Keys of a stream that are remembered."""


@dataclass(slots=True)
class Waiting(Generic[Item]):
    """What is remembered of a stream as long as not all goes on as it comes."""

    told: dict[int, Item] = field(default_factory=dict)  # of what was before
    told_from: dict[str, int] = field(default_factory=dict)  # the first of each key
    held: dict[int, tuple[int, Item]] = field(default_factory=dict)  # with when it came
    held_bytes: int = 0
    newest: int = 0
    due_ns: int | None = None  # when to look whether to wait no longer; None: nothing waits
    recovered_ns: int = 0  # when something that was missing came last, or it began to be missing
    reached: dict[str, int] = field(default_factory=dict)  # the newest number that came of a key, if it is not old

    def tell(self, key: str, number: int, item: Item) -> None:
        """Note a message of before, if there is room."""
        if len(self.told) < MOST_HELD:
            self.told[number] = item
            self.told_from[key] = min(self.told_from.get(key, number), number)

    @property
    def is_full(self) -> bool:
        """Whether more waits than there is room for."""
        return len(self.held) > MOST_HELD or self.held_bytes > MOST_HELD_BYTES

    @property
    def told_by_all(self) -> int:
        """From where on what was before was told of every key: of one less is remembered than of another."""
        return max(self.told_from.values(), default=0)


@dataclass(slots=True)
class Stream(Generic[Item]):
    """A stream."""

    publisher: int
    name: str
    expected: int | None = None
    begun: int = -1  # the number that went on first
    before: int = -1  # the last number when the listening began
    heard_ns: int = 0  # when something came last
    keys: tuple[str, ...] = ()
    waiting: Waiting[Item] | None = None
    lost: list[tuple[int, int]] | None = None  # (first, last)

    def note(self, key: str, number: int) -> None:
        """A key has come to a number."""
        if key not in self.keys:
            if len(self.keys) >= MOST_KEYS:
                return
            self.keys = (*self.keys, key)
        if self.expected is None or number >= self.expected:
            reached = self.wait().reached
            reached[key] = max(reached.get(key, number), number)

    @property
    def passed(self) -> int:
        """The number that every key has come to; -1 if one of them has not come beyond what is expected."""
        waiting = self.wait()
        return min((waiting.reached.get(key, -1) for key in self.keys), default=waiting.newest)

    @property
    def is_strange(self) -> bool:
        """Whether one number came, of which nobody knows what it followed."""
        return self.waiting is None and self.before < 0 < self.begun and self.expected == self.begun + 1

    def wait(self) -> Waiting[Item]:
        """What is remembered as long as something waits."""
        if self.waiting is None:
            self.waiting = Waiting()
        return self.waiting

    def settle(self) -> None:
        """Forget what is only wanted as long as something waits, if nothing does."""
        waiting = self.waiting
        if waiting is None or waiting.held or waiting.told or self.expected is None:
            return
        waiting.reached = {key: number for key, number in waiting.reached.items() if number >= self.expected}
        if not waiting.reached:
            self.waiting = None

    def goes_on_from(self, number: int) -> None:
        """All up to a number has gone on, or is given up."""
        if self.expected is None:
            self.begun = number
        self.expected = number + 1
