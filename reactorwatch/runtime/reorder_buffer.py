"""Reorder buffer: restores the order of publication and reports gaps. Pure: the time is an argument.

Zenoh keeps the order on each key. Across keys it does so as long as nothing is lost; but messages recovered after a
cut, or sent to a late subscriber, arrive key by key: first all that is missing of one signal, then of the next. That
would take rows of samples apart, so a publisher numbers its messages. It numbers each *stream* separately: all of one
kind of one plant (`reactor/cstr/sample`) that one role may publish (see `delivery`), so that a subscriber to one kind
knows whether a number is missing or was on keys it does not subscribe to.

A message is released when all before it in its stream have been. While a number is missing, those after it are held
until it is lost and reported as a gap. It is certainly lost when every key of the stream has reached a later number,
because each key keeps its order; only a key never seen before might still bring it, which is waited for
(`TIMEOUT_NS`). While a key has not reached that far, its recovery may be under way, or it publishes nothing: that is
waited for longer than Zenoh waits for the answer to a query (`RECOVERY_TIMEOUT_NS`). A repeated number is dropped, and
so is one from before the first that was released. A message that arrives after it was given up is released at once,
out of order, unless it is later than its subscriber can use.

A new subscriber queries every publisher for its last number, and perhaps for its history; until that is complete all
messages are held (`await_history`). It queries again while something is missing (`history_complete`): during a large
history, live messages may be dropped on the way, and Zenoh does not notice before it has received the first of a key.
The subscriber can then tell history from live messages. A stream without a known last number starts with 0. If another
number arrives first, the stream may have begun while the link was down, so its publisher is queried too; it then starts
with the oldest number, when nothing older has arrived for `START_WINDOW_NS`.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import accumulate
from math import inf
from typing import Generic, NamedTuple, TypeVar

from reactorwatch.runtime.gap_tracker import GapTracker

Item = TypeVar("Item")

TIMEOUT_NS = 5_000_000_000  # of a stream whose keys have all gone on: what they passed is lost
RECOVERY_TIMEOUT_NS = 15_000_000_000
"""Zenoh gives a query up after 10 s; then it releases what it has."""
POLL_NS = 250_000_000  # within the timeout it makes no difference
START_WINDOW_NS = 500_000_000
MAX_STREAMS = 100_000
"""Largest number of stored streams. A restarted publisher is another stream, and so is each plant of a fleet."""
ORPHAN_TIMEOUT_NS = 60_000_000_000
"""Time after which a stream is evicted that started with another number than 0, without a known last number and without
a second message: garbage makes one stream a message."""
MAX_HELD = 1_000_000
MAX_HELD_BYTES = 256 << 20
"""Messages of a stream that may be held, and their payload; beyond either, missing messages are given up."""
MAX_KEYS = 1000
"""Keys of a stream that are tracked."""


class KeyHistory(NamedTuple):
    """First and last number of the history of a key, and how many messages it has."""

    first: int
    last: int
    messages: int

    def is_cut_off(self, begin: int) -> bool:
        """True if there should be a message between this number, of another key, and the first."""
        return self.messages > 2 and self.first - begin > 2 * (self.last - self.first) / (self.messages - 1)


@dataclass(slots=True)
class HoldState(Generic[Item]):
    """State of a stream while messages are held back.

    A fleet has tens of thousands of streams, nearly all of which hold no message back: so this is an object of its own.
    """

    history: dict[int, Item] = field(default_factory=dict)  # published before the subscription, by number
    history_of: dict[str, KeyHistory] = field(default_factory=dict)
    held: dict[int, tuple[int, Item]] = field(default_factory=dict)  # arrival time and message, by number
    held_bytes: int = 0
    newest: int = 0
    due_ns: int | None = None  # when to check whether to hold no longer; None: nothing is held
    after_ns: int = 0  # when the last message before the first held one arrived
    queried_ns: int = 0  # when publishers were last queried for what is missing
    recovered_ns: int = 0  # when a missing message arrived last, or the first one was found missing
    reached: dict[str, int] = field(default_factory=dict)  # newest number by key, unless it is below the expected one

    def add_history(self, key: str, number: int, item: Item) -> bool:
        """Store a message published before the subscription, if there is room; True if it is new."""
        is_new = number not in self.history and len(self.history) < MAX_HELD
        if is_new:
            self.history[number] = item
            first, last, count = self.history_of.get(key, (number, number, 0))
            self.history_of[key] = KeyHistory(min(first, number), max(last, number), count + 1)
        return is_new

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
        return max((item.first for item in self.history_of.values()), default=0)

    @property
    def is_partial(self) -> bool:
        """True if the history of a key begins later than its usual spacing explains, or there is none of any key."""
        begin = min((item.first for item in self.history_of.values()), default=None)
        return begin is None or any(item.is_cut_off(begin) for item in self.history_of.values())


@dataclass(slots=True, kw_only=True)
class StreamState(GapTracker, Generic[Item]):
    """Position in a stream; its gaps are given up, and a message in one is released at once."""

    max_gaps = 100_000

    publisher: int
    stream: str
    first: int = -1  # number of the first message released
    last_before: int = -1  # last number published before the subscription
    is_recent: bool = False  # it is recent enough to be part of the history
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


class Gap(NamedTuple):
    """Messages that never arrived and were given up together.

    Attributes:
        stream: plant and kind, as the start of their keys.
        publisher: random number that the publisher drew when it started.
        first: number of the first of them in the stream.
        last: number of the last; between them others may have arrived, on another key for instance.
        messages: count of missing messages.
        noticed_ns: time when they were given up, by the clock of receipt.
    """

    stream: str
    publisher: int
    first: int
    last: int
    messages: int
    noticed_ns: int


class ReorderBuffer(Generic[Item]):
    """Releases messages in the order of their numbers.

    Args:
        await_history: hold all messages until `end_history`.
        size: size of a message in bytes; by default 0.
        start_ns: time when the subscription began.
        late_rows: number of messages of each key of a stream, up to which one that was given up and arrives late is
            released.
    """

    def __init__(
        self,
        *,
        await_history: bool = False,
        size: Callable[[Item], int] = lambda _: 0,
        start_ns: int = 0,
        late_rows: float = inf,
    ) -> None:
        self._size, self._late_rows = size, late_rows
        self._streams: dict[tuple[int, str], StreamState[Item]] = {}
        self._by_key: dict[str, StreamState[Item]] = {}  # stream that a key's last released message was of
        self._holding: dict[tuple[int, str], StreamState[Item]] = {}  # all streams with held messages; perhaps others
        self._await_history = await_history
        self._start_ns = start_ns
        self._starts_known_ns: dict[str, int] = {}  # time up to which a stream was searched for unknown starts
        self._unconfirmed = deque[tuple[int, tuple[int, str]]]()  # when each stream was new, oldest first

    def accept_next(self, publisher: int, key: str, number: int, now_ns: int) -> bool:
        """Accept a message if it is the expected one and none is held; True: release it. The usual case."""
        state = self._by_key.get(key)
        if state is None or number != state.expected or publisher != state.publisher or state.hold is not None:
            return False
        state.expected, state.last_arrival_ns = number + 1, now_ns
        return True

    def push(self, publisher: int, stream: str, key: str, number: int, item: Item, now_ns: int) -> Iterator[Item | Gap]:
        """Add a message; yields the messages that it releases, and the gaps between them."""
        state = self._streams.get((publisher, stream))
        if state is None:
            state = self._add_stream((publisher, stream), now_ns)
            if not number and not self._await_history:
                state.expected = 0
        last_arrival_ns, state.last_arrival_ns = state.last_arrival_ns, now_ns
        state.record_key(key, number)
        if state.expected is None and not self._await_history and number <= state.last_before:
            return
        if number == state.expected and not (state.hold is not None and state.hold.held):  # the usual case
            state.expected = number + 1
            state.drop_hold_state()
            if key in state.keys:
                self._by_key[key] = state
            yield item
            return
        if state.expected is not None and number < state.expected:
            if state.fill(number) and state.expected - number <= self._late_rows * max(len(state.keys), 1):
                yield item  # given up before, and arrived after all
            return
        yield from self._hold(state, number, item, now_ns, last_arrival_ns)

    def _hold(
        self, state: StreamState[Item], number: int, item: Item, now_ns: int, last_arrival_ns: int
    ) -> Iterator[Item | Gap]:
        """Hold a message while others before it are missing; yields the messages released nevertheless."""
        hold = state.hold_state()
        if not hold.held:
            hold.after_ns = last_arrival_ns or now_ns
        if self._await_history and hold.is_full:
            return  # it will be reported as missing
        if number not in hold.held:
            hold.held[number] = now_ns, item
            hold.held_bytes += self._size(item)
        if self._await_history:
            return
        timeout_ns = START_WINDOW_NS if state.expected is None else TIMEOUT_NS
        if hold.due_ns is None or number < hold.newest:  # the first message is held, or a missing one has arrived
            hold.due_ns = now_ns + timeout_ns
            hold.recovered_ns = now_ns
            self._holding[state.name] = state
        hold.newest = max(hold.newest, number)
        if number == 0 and state.expected is None:
            state.expected = 0
        yield from self._release_contiguous(state, hold)
        if hold.is_full:
            yield from self._give_up(state, hold, now_ns, now_ns, hold.newest)

    def release_overdue(self, now_ns: int, *, only_queried: bool = False) -> Iterator[Item | Gap]:
        """Give up missing messages whose timeout is over; yields the gaps and the messages released.

        Args:
            now_ns: clock reading.
            only_queried: leave out streams that `take_overdue` has not named since their oldest held message arrived.
        """
        for state in list(self._holding.values()):
            hold = state.hold
            if hold is None or hold.due_ns is None or now_ns < hold.due_ns:
                continue
            if only_queried and not hold.is_queried:
                continue
            recovery_end_ns = hold.recovered_ns + RECOVERY_TIMEOUT_NS
            reached = hold.newest if now_ns >= recovery_end_ns else state.reached_by_all
            if state.expected is None or state.expected < reached:
                since_ns = now_ns if state.expected is None else now_ns - TIMEOUT_NS
                yield from self._give_up(state, hold, since_ns, now_ns, reached)
            else:
                hold.due_ns = min(now_ns + POLL_NS, recovery_end_ns)

    def set_last(self, publisher: int, stream: str, key: str, number: int, *, is_recent: bool = False) -> None:
        """Before `end_history`: record the last number that a publisher reports for one of its keys."""
        state = self._stream(publisher, stream)
        state.record_key(key, number)
        state.last_before, state.is_recent = max(state.last_before, number), state.is_recent or is_recent

    def add_history(self, publisher: int, stream: str, key: str, number: int, item: Item) -> bool:
        """Before `end_history`: add a message that was published before the subscription; True if it is new."""
        return self._stream(publisher, stream).hold_state().add_history(key, number, item)

    def history_complete(self) -> bool:
        """Before `end_history`: True if nothing is missing in the history, nor between it and live messages.

        The beginning of a key's history may be missing because its publisher caches no more, or because the replies
        were lost on their way: the latter is assumed.
        """
        for state in self._streams.values():
            hold = state.hold
            # a last number that is unknown: the replies with it were lost, too
            is_unknown = hold is not None and state.last_before < 0 and hold.held and 0 not in hold.held
            if hold is None or not (hold.history or state.is_recent or is_unknown):
                continue
            if hold.is_partial:
                return False
            first = hold.complete_from
            numbers = {number for number in (*hold.history, *hold.held) if number >= first}
            if len(numbers) <= max(state.last_before, *numbers) - first:
                return False
        return True

    def end_history(self, now_ns: int) -> Iterator[Item | Gap]:
        """End the wait for history; yields the messages released."""
        self._await_history = False
        for state in self._streams.values():
            hold = state.hold_state()
            # A message of the history that arrived live is not missing in it, see `history_complete`.
            begin = min((*hold.history, state.last_before + 1))
            live = {number: held for number, held in hold.held.items() if number >= begin}
            hold.held = {number: (now_ns, item) for number, item in hold.history.items()} | live
            hold.history = {}
            hold.held_bytes = sum(self._size(item) for _, item in hold.held.values())
            for number in sorted(number for number in hold.held if number < hold.complete_from):
                yield self._release(hold, number)
            hold.newest = max(hold.held, default=state.last_before)
            if hold.held:
                yield from self._give_up(state, hold, now_ns, now_ns, hold.newest)
            elif state.last_before >= 0:
                state.advance(state.last_before)
            state.drop_hold_state()

    def due_ns(self) -> int | None:
        """Time of the next `release_overdue`; None: nothing is held."""
        if not self._holding:
            return None
        due = {name: state.hold.due_ns for name, state in self._holding.items() if state.hold is not None}
        self._holding = {name: state for name, state in self._holding.items() if due.get(name) is not None}
        return min((due_ns for due_ns in due.values() if due_ns is not None), default=None)

    def take_overdue(self, now_ns: int) -> dict[str, int]:
        """Streams in which a message is overdue, or may be missing before an unknown start; each gap is named once.

        Returns:
            Time by stream after which what is missing was published: when the message before it arrived or, with an
            unknown start, when the subscription began or publishers were last queried for such a start.
        """
        overdue: dict[str, int] = {}
        for (_, stream), state in self._holding.items():
            hold = state.hold
            if hold is None or hold.due_ns is None or hold.due_ns > now_ns or hold.is_queried:
                continue
            hold.queried_ns = now_ns
            is_start = state.expected is None
            after_ns = self._starts_known_ns.get(stream, self._start_ns) if is_start else hold.after_ns
            overdue[stream] = min(overdue.get(stream, after_ns), after_ns, hold.first_arrival_ns)
        return overdue

    def is_missing_before(self, stream: str, oldest: Mapping[int, int]) -> bool:
        """True if a message is missing before the oldest number that a publisher's cache returned, by publisher."""
        states = {publisher: self._streams.get((publisher, stream)) for publisher in oldest}
        return any(
            state is not None
            and state.hold is not None
            and state.hold.held
            and state.expected is not None
            and state.expected < oldest[publisher]
            for publisher, state in states.items()
        )

    def _stream(self, publisher: int, stream: str) -> StreamState[Item]:
        return self._streams.get((publisher, stream)) or self._add_stream((publisher, stream), 0)

    def _add_stream(self, name: tuple[int, str], now_ns: int) -> StreamState[Item]:
        """Add a stream; evict orphans that timed out and, if there is no room, the longest idle ones."""
        while self._unconfirmed and (
            now_ns - self._unconfirmed[0][0] >= ORPHAN_TIMEOUT_NS or len(self._streams) >= MAX_STREAMS
        ):
            _, oldest = self._unconfirmed.popleft()
            if (unconfirmed := self._streams.get(oldest)) is not None and unconfirmed.is_orphan:
                self._evict(oldest)
        if len(self._streams) >= MAX_STREAMS:
            idle = [(state.last_arrival_ns, other) for other, state in self._streams.items() if state.hold is None]
            for _, longest_idle in sorted(idle)[: MAX_STREAMS // 10]:
                self._evict(longest_idle)
        state: StreamState[Item] = StreamState(publisher=name[0], stream=name[1])
        self._streams[name] = state
        self._unconfirmed.append((now_ns, name))
        return state

    def _evict(self, name: tuple[int, str]) -> None:
        state = self._streams.pop(name)
        for key in state.keys:
            if self._by_key.get(key) is state:
                del self._by_key[key]

    def _mark_starts_known(self, stream: str, until_ns: int) -> None:
        """Mark that all publishers of a stream were queried for what they published until this time.

        Otherwise each made-up publisher would cause a query for everything since the subscription began.
        """
        self._starts_known_ns.pop(stream, None)
        self._starts_known_ns[stream] = until_ns
        if len(self._starts_known_ns) > MAX_STREAMS:
            del self._starts_known_ns[next(iter(self._starts_known_ns))]

    def _release(self, hold: HoldState[Item], number: int) -> Item:
        item = hold.held.pop(number)[1]
        hold.held_bytes -= self._size(item)
        return item

    def _release_contiguous(self, state: StreamState[Item], hold: HoldState[Item]) -> Iterator[Item]:
        while state.expected is not None and state.expected in hold.held:
            yield self._release(hold, state.expected)
            state.expected += 1
        if not hold.held:
            hold.due_ns = None
            state.drop_hold_state()

    def _give_up(
        self, state: StreamState[Item], hold: HoldState[Item], since_ns: int, now_ns: int, reached: int
    ) -> Iterator[Item | Gap]:
        """Give up, as one gap, all that is missing before messages that arrived until `since_ns`.

        Messages missing beyond `reached`, the number that every key has reached, are still waited for.
        """
        items: list[Item] = []
        lost: list[tuple[int, int]] = []
        is_start = state.expected is None
        numbers = sorted(hold.held)
        arrival_ns = [hold.held[number][0] for number in numbers]
        noticed_ns = list(accumulate(reversed(arrival_ns), min))[::-1]  # earliest arrival at or behind each number
        if is_start and hold.queried_ns:
            self._mark_starts_known(state.stream, hold.queried_ns)
        for number, known_ns in zip(numbers, noticed_ns, strict=True):
            is_behind_gap = state.expected is not None and number > state.expected
            if is_behind_gap and (is_start or known_ns > since_ns or number > reached):
                break  # the missing ones may still arrive
            if skipped := state.advance(number):
                lost.append((number - skipped, number - 1))
            items.append(self._release(hold, number))
        hold.due_ns = None
        if hold.held:
            first_ns = hold.first_arrival_ns
            hold.due_ns = first_ns + TIMEOUT_NS
            self._holding[state.name] = state
            hold.recovered_ns = max(hold.recovered_ns, first_ns)
        state.drop_hold_state()
        if lost:
            count = sum(last - first + 1 for first, last in lost)
            yield Gap(state.stream, state.publisher, lost[0][0], lost[-1][1], count, now_ns)
        yield from items
