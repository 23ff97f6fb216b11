"""The order in which a node published, for whoever listens. Pure: it is told what time it is.

Zenoh keeps the order on each key. Across keys it does so as long as nothing is lost; but what is recovered after a cut,
or told to a late listener, comes key by key: first all that is missing of one signal, then of the next. A row of
samples would be taken apart by that, so a publisher numbers what it publishes. It does so in each *stream* by itself,
which is all of one kind of one plant (`reactor/cstr/sample`) that one role may publish (see `streams`), so that a
listener to one kind knows whether a number is missing or was none of its business.

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
from collections import deque
from collections.abc import Callable, Iterator
from itertools import accumulate
from operator import itemgetter
from typing import Generic, NamedTuple

from reactorwatch.runtime.delivery.stream_state import Item, Stream, Waiting

PATIENCE_NS = 5_000_000_000
RECOVERY_NS = 15_000_000_000
"""Zenoh gives a question up after 10 s; then it hands on what it has."""
LOOK_AGAIN_NS = 250_000_000
GATHER_NS = 500_000_000
MOST_LOST = 100_000
"""Runs of lost numbers of a stream that are remembered: what comes of them after all goes on."""
MOST_STREAMS = 100_000
"""That are remembered. A publisher that is started anew is another stream, so is each plant of a fleet."""
STRANGE_NS = 60_000_000_000
"""A stream that began with another number than 0, of which no last number was known and no second message came in this
time, is forgotten: garbage makes a stream a message."""


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


class InOrder(Generic[Item]):
    """Lets messages through in the order of their numbers.

    Args:
        gathering: whether everything waits, at first, until `gathered`.
        size: of a message, in bytes; without it, none has any.
    """

    def __init__(self, *, gathering: bool = False, size: Callable[[Item], int] = lambda _: 0) -> None:
        self._size = size
        self._streams: dict[tuple[int, str], Stream[Item]] = {}
        self._by_key: dict[str, Stream[Item]] = {}  # that went on last on a key
        self._waiting: dict[tuple[int, str], Stream[Item]] = {}  # all in which something waits; perhaps others
        self._gathering = gathering
        self._unproven = deque[tuple[int, tuple[int, str]]]()  # when each stream was new; the oldest stand first

    def takes_next(self, publisher: int, key: str, number: int, now_ns: int) -> bool:
        """Take a message in if it is the one that is expected, and nothing waits: it goes on. As nearly always."""
        state = self._by_key.get(key)
        if state is None or number != state.expected or publisher != state.publisher or state.waiting is not None:
            return False
        state.expected, state.heard_ns = number + 1, now_ns
        return True

    def arrive(
        self, publisher: int, stream: str, key: str, number: int, item: Item, now_ns: int
    ) -> Iterator[Item | Gap]:
        """Take a message in; yields what goes on because of it, and the gaps between."""
        name = publisher, stream
        state = self._streams.get(name)
        if state is None:
            state = self._new(name, now_ns)
            if not number and not self._gathering:
                state.expected = 0
        state.heard_ns = now_ns
        state.note(key, number)
        if state.expected is None and not self._gathering and number <= state.before:
            return
        if number == state.expected and not (state.waiting is not None and state.waiting.held):  # as nearly always
            state.expected = number + 1
            state.settle()
            if key in state.keys:
                self._by_key[key] = state
            yield item
            return
        if state.expected is not None and number < state.expected:
            if state.lost is not None and _take_out(state.lost, number):
                yield item  # it was given up, and has come after all
            return
        yield from self._wait(name, state, number, item, now_ns)

    def _wait(
        self, name: tuple[int, str], state: Stream[Item], number: int, item: Item, now_ns: int
    ) -> Iterator[Item | Gap]:
        """Keep a message for which something is missing; yields what goes on nevertheless."""
        waiting = state.wait()
        if self._gathering and waiting.is_full:
            return  # it will be told as missing
        if number not in waiting.held:
            waiting.held[number] = now_ns, item
            waiting.held_bytes += self._size(item)
        if self._gathering:
            return
        patience_ns = GATHER_NS if state.expected is None else PATIENCE_NS
        if waiting.due_ns is None or number < waiting.newest:  # something begins to be waited for, or is recovered
            waiting.due_ns = now_ns + patience_ns
            waiting.recovered_ns = now_ns
            self._waiting[name] = state
        waiting.newest = max(waiting.newest, number)
        yield from self._contiguous(state, waiting)
        if waiting.is_full:
            yield from self._give_up(name, state, waiting, now_ns, now_ns, waiting.newest)

    def overdue(self, now_ns: int) -> Iterator[Item | Gap]:
        """Yields what has waited for long enough."""
        for name, state in list(self._waiting.items()):
            waiting = state.waiting
            if waiting is None or waiting.due_ns is None or now_ns < waiting.due_ns:
                continue
            silent_until_ns = waiting.recovered_ns + RECOVERY_NS
            passed = waiting.newest if now_ns >= silent_until_ns else state.passed
            if state.expected is None or state.expected < passed:
                since_ns = now_ns if state.expected is None else now_ns - PATIENCE_NS
                yield from self._give_up(name, state, waiting, since_ns, now_ns, passed)
            else:
                waiting.due_ns = min(now_ns + LOOK_AGAIN_NS, silent_until_ns)

    def tell_last(self, publisher: int, stream: str, key: str, number: int) -> None:
        """While gathering: the number that a publisher has come to on one of its keys."""
        state = self._stream(publisher, stream)
        state.note(key, number)
        state.before = max(state.before, number)

    def tell(self, publisher: int, stream: str, key: str, number: int, item: Item) -> None:
        """While gathering: a message of before."""
        self._stream(publisher, stream).wait().tell(key, number, item)

    def is_told(self) -> bool:
        """While gathering: whether nothing is missing of what was before, nor between it and what has come since."""
        for state in self._streams.values():
            waiting = state.waiting
            if waiting is None or not waiting.told:
                continue
            first = waiting.told_by_all
            numbers = {number for number in (*waiting.told, *waiting.held) if number >= first}
            if len(numbers) <= max(state.before, *numbers) - first:
                return False
        return True

    def gathered(self, now_ns: int) -> Iterator[Item | Gap]:
        """What was before has all been told; yields what goes on."""
        self._gathering = False
        for name, state in self._streams.items():
            waiting = state.wait()
            live = {number: came for number, came in waiting.held.items() if number > state.before}
            waiting.held = {number: (now_ns, item) for number, item in waiting.told.items()} | live
            waiting.told = {}
            waiting.held_bytes = sum(self._size(item) for _, item in waiting.held.values())
            for number in sorted(number for number in waiting.held if number < waiting.told_by_all):
                yield self._released(waiting, number)
            waiting.newest = max(waiting.held, default=state.before)
            if waiting.held:
                yield from self._give_up(name, state, waiting, now_ns, now_ns, waiting.newest)
            elif state.before >= 0:
                state.goes_on_from(state.before)
            state.settle()

    def _stream(self, publisher: int, stream: str) -> Stream[Item]:
        return self._streams.get((publisher, stream)) or self._new((publisher, stream), 0)

    def _new(self, name: tuple[int, str], now_ns: int) -> Stream[Item]:
        """Begin to remember a stream; forget what is due."""
        while self._unproven and (now_ns - self._unproven[0][0] >= STRANGE_NS or len(self._streams) >= MOST_STREAMS):
            _, oldest = self._unproven.popleft()
            if (found := self._streams.get(oldest)) is not None and found.is_strange:
                self._forget(oldest)
        if len(self._streams) >= MOST_STREAMS:
            idle = [(state.heard_ns, known) for known, state in self._streams.items() if state.waiting is None]
            for _, longest_silent in sorted(idle)[: MOST_STREAMS // 10]:
                self._forget(longest_silent)
        state: Stream[Item] = Stream(*name)
        self._streams[name] = state
        self._unproven.append((now_ns, name))
        return state

    def _forget(self, name: tuple[int, str]) -> None:
        state = self._streams.pop(name)
        for key in state.keys:
            if self._by_key.get(key) is state:
                del self._by_key[key]

    def _released(self, waiting: Waiting[Item], number: int) -> Item:
        item = waiting.held.pop(number)[1]
        waiting.held_bytes -= self._size(item)
        return item

    def due_ns(self) -> int | None:
        """When to ask for what is overdue; None: nothing waits."""
        if not self._waiting:
            return None
        due = {name: state.waiting.due_ns for name, state in self._waiting.items() if state.waiting is not None}
        self._waiting = {name: state for name, state in self._waiting.items() if due.get(name) is not None}
        return min((due_ns for due_ns in due.values() if due_ns is not None), default=None)

    def waiting(self, now_ns: int) -> dict[str, int]:
        """The streams of which something is overdue, with when the first came that waits for it.

        Not those of which nobody knows how they began: nothing is missing there.
        """
        found: dict[str, int] = {}
        for (_, stream), state in self._waiting.items():
            waiting = state.waiting
            if waiting is None or state.expected is None or not waiting.held:
                continue
            if waiting.due_ns is not None and waiting.due_ns <= now_ns:
                since_ns = min(came_ns for came_ns, _ in waiting.held.values())
                found[stream] = min(found.get(stream, since_ns), since_ns)
        return found

    def _contiguous(self, state: Stream[Item], waiting: Waiting[Item]) -> Iterator[Item]:
        while state.expected is not None and state.expected in waiting.held:
            yield self._released(waiting, state.expected)
            state.expected += 1
        if not waiting.held:
            waiting.due_ns = None
            state.settle()

    def _give_up(
        self,
        name: tuple[int, str],
        state: Stream[Item],
        waiting: Waiting[Item],
        since_ns: int,
        now_ns: int,
        passed: int,
    ) -> Iterator[Item | Gap]:
        """Do not wait for what is missing before what came until a moment: all of that was lost at once.

        What is missing beyond `passed`, the number that every key has come to, is still waited for.
        """
        items: list[Item] = []
        lost: list[tuple[int, int]] = []
        gathered = state.expected is None
        numbers = sorted(waiting.held)
        came_ns = [waiting.held[number][0] for number in numbers]
        noticed_ns = list(accumulate(reversed(came_ns), min))[::-1]  # when the first came that is behind it, or it did
        for number, known_ns in zip(numbers, noticed_ns, strict=True):
            if state.expected is not None and number > state.expected:
                if gathered or known_ns > since_ns or number > passed:
                    break  # what is missing here may still come
                lost.append((state.expected, number - 1))
            state.goes_on_from(number)
            items.append(self._released(waiting, number))
        waiting.due_ns = None
        if waiting.held:
            first_ns = min(came for came, _ in waiting.held.values())
            waiting.due_ns = first_ns + PATIENCE_NS
            self._waiting[name] = state
            waiting.recovered_ns = max(waiting.recovered_ns, first_ns)
        state.settle()
        if lost:
            state.lost = [*(state.lost or ()), *lost][-MOST_LOST:]
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
