"""The order in which a node published, for whoever listens. Pure: it is told what time it is.

Zenoh keeps the order on each key. Across keys it does so as long as nothing is lost; but what is recovered after a cut,
or told to a late listener, comes key by key: first all that is missing of one signal, then of the next. A row of
samples would be taken apart by that, so a publisher numbers what it publishes. It does so in each *stream* by itself,
which is all of one kind of one plant (`reactor/cstr/sample`), so that a listener to one kind knows whether a number is
missing or was none of its business.

A message goes on when all before it in its stream have. While a number is missing those after it wait, until it is
lost, and told as a gap. It is lost for certain when every key of the stream has come to a later one, because each key
keeps its order; only a key that was never heard before might still bring it, so that is waited for, too
(`PATIENCE_NS`). While a key has not come so far, its recovery may still be under way, or it has fallen silent: that is
waited for longer than Zenoh waits for the answer to a question (`RECOVERY_NS`). A number that comes again is passed
over, and so is what was published before the first that went on. What comes after it was given up goes on at once,
out of its place, rather than nowhere.

Who begins to listen asks every publisher for its last number, and perhaps for what was before; until he has been
told, everything waits (`gathering`). He asks again where something is missing (`is_told`): while much is told, what
comes live may be thrown away on the way, and Zenoh does not know that it is missing before it has heard the first of a
key. So he knows what is of before his time, which a publisher may send him again,
and what not. A stream of which he was told nothing begins with 0, or, if he hears another number first, when for a
moment (`GATHER_NS`) nothing came that was older than what he had heard already.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import accumulate
from operator import itemgetter
from typing import Generic, NamedTuple, TypeVar

Item = TypeVar("Item")

PATIENCE_NS = 5_000_000_000
RECOVERY_NS = 15_000_000_000
"""Zenoh gives a question up after 10 s; then it hands on what it has."""
LOOK_AGAIN_NS = 250_000_000
GATHER_NS = 500_000_000
MOST_LOST = 100_000
"""Runs of lost numbers of a stream that are remembered: what comes of them after all goes on."""
MOST_HELD = 1_000_000
MOST_HELD_BYTES = 256 << 20
"""Messages of a stream that may wait, and their payload; with more, what is missing is given up."""
MOST_STREAMS = 100_000
MOST_KEYS = 10_000
"""Streams, and keys of a stream, that are remembered. A publisher that is started anew is another stream, so is each
plant of a fleet."""


class Gap(NamedTuple):
    """Messages that never came: what was given up at one time.

    Attributes:
        stream: plant and kind, as the beginning of their keys.
        publisher: who published them, a number that a node draws when it starts.
        first: number of the first of them in the stream.
        last: number of the last; between them others may have come, of another key for instance.
        messages: how many.
        noticed_ns: when they were given up, by the clock of receipt.
    """

    stream: str
    publisher: int
    first: int
    last: int
    messages: int
    noticed_ns: int


@dataclass(slots=True)
class _Stream(Generic[Item]):
    expected: int | None = None
    newest: int = 0
    before: int = -1  # the last number when the listening began
    told: dict[int, Item] = field(default_factory=dict)  # of what was before
    told_from: dict[str, int] = field(default_factory=dict)  # the first of each key
    held: dict[int, tuple[int, Item]] = field(default_factory=dict)  # with when it came
    held_bytes: int = 0
    heard_ns: int = 0  # when something came last
    due_ns: int | None = None  # when to look whether to wait no longer; None: nothing waits
    recovered_ns: int = 0  # when something that was missing came last, or it began to be missing
    keys: dict[str, int] = field(default_factory=dict)  # the newest number that came of each
    lost: list[tuple[int, int]] = field(default_factory=list)  # (first, last)

    @property
    def is_full(self) -> bool:
        """Whether more waits than there is room for."""
        return len(self.held) > MOST_HELD or self.held_bytes > MOST_HELD_BYTES

    def note(self, key: str, number: int) -> None:
        """A key has come to a number."""
        if key in self.keys or len(self.keys) < MOST_KEYS:
            self.keys[key] = max(self.keys.get(key, number), number)

    @property
    def passed(self) -> int:
        """The number that every key has come to."""
        return min(self.keys.values(), default=self.newest)

    @property
    def told_by_all(self) -> int:
        """From where on what was before was told of every key: of one less is remembered than of another."""
        return max(self.told_from.values(), default=0)


class InOrder(Generic[Item]):
    """Lets messages through in the order of their numbers.

    Args:
        gathering: whether everything waits, at first, until `gathered`.
        size: of a message, in bytes; without it, none has any.
    """

    def __init__(self, *, gathering: bool = False, size: Callable[[Item], int] = lambda _: 0) -> None:
        self._size = size
        self._streams: dict[tuple[int, str], _Stream[Item]] = {}
        self._waiting: dict[tuple[int, str], _Stream[Item]] = {}  # all in which something waits; perhaps others
        self._gathering = gathering

    def takes_next(self, publisher: int, stream: str, key: str, number: int, now_ns: int) -> bool:
        """Take a message in if it is the one that is expected, and nothing waits: it goes on. As nearly always."""
        state = self._streams.get((publisher, stream))
        if state is None or number != state.expected or state.held:
            return False
        state.note(key, number)
        state.expected, state.heard_ns = number + 1, now_ns
        return True

    def arrive(
        self, publisher: int, stream: str, key: str, number: int, item: Item, now_ns: int
    ) -> Iterator[Item | Gap]:
        """Take a message in; yields what goes on because of it, and the gaps between."""
        name = publisher, stream
        state = self._streams.get(name)
        if state is None:
            state = self._new(name)
            if not number and not self._gathering:
                state.expected = 0
        state.heard_ns = now_ns
        state.note(key, number)
        if state.expected is None and not self._gathering and number <= state.before:
            return
        if number == state.expected and not state.held:  # as nearly always
            state.expected = number + 1
            yield item
            return
        if state.expected is not None and number < state.expected:
            if _take_out(state.lost, number):
                yield item  # it was given up, and has come after all
            return
        if self._gathering and state.is_full:
            return  # it will be told as missing
        if number not in state.held:
            state.held[number] = now_ns, item
            state.held_bytes += self._size(item)
        if self._gathering:
            return
        patience_ns = GATHER_NS if state.expected is None else PATIENCE_NS
        if state.due_ns is None or number < state.newest:  # something begins to be waited for, or is being recovered
            state.due_ns = now_ns + patience_ns
            state.recovered_ns = now_ns
            self._waiting[name] = state
        state.newest = max(state.newest, number)
        yield from self._contiguous(state)
        if state.is_full:
            yield from self._give_up(name, state, now_ns, now_ns, state.newest)

    def overdue(self, now_ns: int) -> Iterator[Item | Gap]:
        """Yields what has waited for long enough."""
        for name, state in list(self._waiting.items()):
            if state.due_ns is None or now_ns < state.due_ns:
                continue
            silent_until_ns = state.recovered_ns + RECOVERY_NS
            passed = state.newest if now_ns >= silent_until_ns else state.passed
            if state.expected is None or state.expected < passed:
                since_ns = now_ns if state.expected is None else now_ns - PATIENCE_NS
                yield from self._give_up(name, state, since_ns, now_ns, passed)
            else:
                state.due_ns = min(now_ns + LOOK_AGAIN_NS, silent_until_ns)

    def tell_last(self, publisher: int, stream: str, key: str, number: int) -> None:
        """While gathering: the number that a publisher has come to on one of its keys."""
        state = self._stream(publisher, stream)
        state.note(key, number)
        state.before = max(state.before, number)

    def tell(self, publisher: int, stream: str, key: str, number: int, item: Item) -> None:
        """While gathering: a message of before."""
        state = self._stream(publisher, stream)
        if len(state.told) >= MOST_HELD:
            return
        state.told[number] = item
        state.told_from[key] = min(state.told_from.get(key, number), number)

    def is_told(self) -> bool:
        """While gathering: whether nothing is missing of what was before, nor between it and what has come since."""
        for state in self._streams.values():
            first = state.told_by_all
            numbers = {number for number in (*state.told, *state.held) if number >= first}
            if state.told and len(numbers) <= max(state.before, *numbers) - first:
                return False
        return True

    def gathered(self, now_ns: int) -> Iterator[Item | Gap]:
        """What was before has all been told; yields what goes on."""
        self._gathering = False
        for name, state in self._streams.items():
            live = {number: came for number, came in state.held.items() if number > state.before}
            state.held = {number: (now_ns, item) for number, item in state.told.items()} | live
            state.told = {}
            state.held_bytes = sum(self._size(item) for _, item in state.held.values())
            for number in sorted(number for number in state.held if number < state.told_by_all):
                yield self._released(state, number)
            state.newest = max(state.held, default=state.before)
            if state.held:
                yield from self._give_up(name, state, now_ns, now_ns, state.newest)
            elif state.before >= 0:
                state.expected = state.before + 1

    def _stream(self, publisher: int, stream: str) -> _Stream[Item]:
        return self._streams.get((publisher, stream)) or self._new((publisher, stream))

    def _new(self, name: tuple[int, str]) -> _Stream[Item]:
        """Begin to remember a stream; if there are too many, those are forgotten that have been silent for longest."""
        if len(self._streams) >= MOST_STREAMS:
            idle = [(state.heard_ns, known) for known, state in self._streams.items() if not (state.held or state.told)]
            for _, known in sorted(idle)[: MOST_STREAMS // 10]:
                del self._streams[known]
        state: _Stream[Item] = _Stream()
        self._streams[name] = state
        return state

    def _released(self, state: _Stream[Item], number: int) -> Item:
        item = state.held.pop(number)[1]
        state.held_bytes -= self._size(item)
        return item

    def due_ns(self) -> int | None:
        """When to ask for what is overdue; None: nothing waits."""
        if not self._waiting:
            return None
        self._waiting = {name: state for name, state in self._waiting.items() if state.due_ns is not None}
        return min((state.due_ns for state in self._waiting.values() if state.due_ns is not None), default=None)

    def waiting(self, now_ns: int) -> dict[str, int]:
        """The streams of which something is overdue, with when the first came that waits for it.

        Not those of which nobody knows how they began: nothing is missing there.
        """
        found: dict[str, int] = {}
        for (_, stream), state in self._waiting.items():
            if state.due_ns is not None and state.due_ns <= now_ns and state.held and state.expected is not None:
                since_ns = min(came_ns for came_ns, _ in state.held.values())
                found[stream] = min(found.get(stream, since_ns), since_ns)
        return found

    def _contiguous(self, state: _Stream[Item]) -> Iterator[Item]:
        while state.expected is not None and state.expected in state.held:
            yield self._released(state, state.expected)
            state.expected += 1
        if not state.held:
            state.due_ns = None

    def _give_up(
        self, name: tuple[int, str], state: _Stream[Item], since_ns: int, now_ns: int, passed: int
    ) -> Iterator[Item | Gap]:
        """Do not wait for what is missing before what came until a moment: all of that was lost at once.

        What is missing beyond `passed`, the number that every key has come to, is still waited for.
        """
        items: list[Item] = []
        lost: list[tuple[int, int]] = []
        gathered = state.expected is None
        numbers = sorted(state.held)
        came_ns = [state.held[number][0] for number in numbers]
        noticed_ns = list(accumulate(reversed(came_ns), min))[::-1]  # when the first came that is behind it, or it did
        for number, known_ns in zip(numbers, noticed_ns, strict=True):
            if state.expected is not None and number > state.expected:
                if gathered or known_ns > since_ns or number > passed:
                    break  # what is missing here may still come
                lost.append((state.expected, number - 1))
            state.expected = number + 1
            items.append(self._released(state, number))
        state.due_ns = None
        if state.held:
            first_ns = min(came for came, _ in state.held.values())
            state.due_ns = first_ns + PATIENCE_NS
            self._waiting[name] = state
            state.recovered_ns = max(state.recovered_ns, first_ns)
        if lost:
            state.lost = [*state.lost, *lost][-MOST_LOST:]
            count = sum(last - first + 1 for first, last in lost)
            yield Gap(name[1], name[0], lost[0][0], lost[-1][1], count, now_ns)
        yield from items


def _take_out(runs: list[tuple[int, int]], number: int) -> bool:
    """Whether a number is in one of the runs, which are in order; it is no longer, then."""
    place = bisect_right(runs, number, key=itemgetter(0)) - 1
    if place < 0 or number > runs[place][1]:
        return False
    first, last = runs[place]
    rest = [(first, number - 1), (number + 1, last)]
    runs[place : place + 1] = [run for run in rest if run[0] <= run[1]]
    return True
