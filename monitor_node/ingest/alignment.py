"""Signals arrive one by one; a model needs rows. This lines them up by the time of the sample.

The policy, in sample times alone, so that a replay does exactly what the live run did:

- A row leaves when every signal of it has come and no older row is waited for. One is waited for that has begun, and
  one that has not while the sequence numbers say that it is missing.
- Nothing is waited for longer than until `reorder_rows` newer rows have begun. Then a row leaves with NaN for what is
  missing in it, and is counted as incomplete.
- A sample for a row that has left is late: counted, and dropped. The same sample twice counts as duplicated.
- A sample older than one of its signal that came before it is out of order: counted, and used if its row is waiting.
- Sequence numbers that jump forward mean lost samples (until they turn up). One that falls back by more than the
  reordering could explain means that the publisher was restarted: what was waiting leaves, and the clock starts anew.
"""

from dataclasses import dataclass, field
from math import nan
from typing import NamedTuple

MOST_LOST = 2**62  # more than any plant publishes: a number may be any nonsense, and a message has to hold the sum
REMEMBERED = 4  # times the reordering: rows that a duplicate is known by, numbers that a restart falls back by


class Row(NamedTuple):
    """What was measured at one time.

    Attributes:
        time_ns: of the samples.
        values: one a signal, in the order of the aligner's signals; NaN: missing.
        restarted: whether this is the first row of a new run of the publisher.
    """

    time_ns: int
    values: tuple[float, ...]
    restarted: bool


@dataclass
class Counts:
    """What happened to samples on their way into rows."""

    rows: int = 0
    incomplete_rows: int = 0
    late: int = 0
    duplicated: int = 0
    out_of_order: int = 0
    lost: int = 0
    restarts: int = 0


@dataclass(slots=True)
class Sequence:
    """Where one signal's numbering is.

    Attributes:
        expected: the number after the highest that has come; None before the first.
        newest_ns: the latest time that has come; of no meaning before the first.
    """

    expected: int | None = None
    newest_ns: int = 0


@dataclass(slots=True)
class Waiting:
    """A row that waits.

    Attributes:
        values: one a signal; NaN where the signal has not come.
        numbers: of their samples; None where the signal has not come.
        missing: how many signals have not come.
    """

    values: list[float]
    numbers: list[int | None]
    missing: int


@dataclass
class AlignmentState:
    """Everything that an aligner remembers.

    Attributes:
        pending: rows that wait, by time.
        left: rows that left last, oldest first: by time, the numbers of their samples, None where one had not come.
        newest_left_ns: time of the row that left last; None before the first.
        newest_numbers: its number of each signal, and if that had not come, what it would have been; None before the
            first.
        sequences: by signal.
        restarted: whether the next row is the first of a new run.
        counts: of what happened so far.
    """

    pending: dict[int, Waiting] = field(default_factory=dict)
    left: dict[int, list[int | None]] = field(default_factory=dict)
    newest_left_ns: int | None = None
    newest_numbers: list[int | None] = field(default_factory=list)
    sequences: list[Sequence] = field(default_factory=list)
    restarted: bool = True
    counts: Counts = field(default_factory=Counts)


class Aligner:
    """Lines samples up into rows.

    Args:
        signals: names, in the order that rows have.
        reorder_rows: how many newer rows may begin before an incomplete one is given up.

    Raises:
        ValueError: `reorder_rows` is less than 1.
    """

    def __init__(self, signals: tuple[str, ...], reorder_rows: int) -> None:
        if reorder_rows < 1:
            raise ValueError(f"reorder_rows must be at least 1, got {reorder_rows}")
        self._index = {signal: index for index, signal in enumerate(signals)}
        self._count = len(signals)
        self._reorder_rows = reorder_rows
        self.state = AlignmentState()
        self._begin()

    def update(self, signal: str, time_ns: int, sequence: int, value: float) -> list[Row]:
        """Take a sample in; returns the rows that leave because of it, oldest first.

        Args:
            signal: one of the aligner's.
            time_ns: of the sample.
            sequence: the publisher's number of it.
            value: finite.
        """
        rows: list[Row] = []
        index, state = self._index[signal], self.state
        position = state.sequences[index]
        if sequence == position.expected and time_ns > position.newest_ns:  # as nearly always
            position.expected, position.newest_ns = sequence + 1, time_ns
        else:
            rows = self._restart(index, time_ns, sequence)
            if self._has_come(index, time_ns):
                state.counts.duplicated += 1
                return rows
            self._count_sequence(state.sequences[index], time_ns, sequence)
        pending = state.pending
        waiting = pending.get(time_ns)
        if waiting is None:
            if state.newest_left_ns is not None and time_ns <= state.newest_left_ns:
                state.counts.late += 1
                return rows
            count = self._count
            waiting = pending[time_ns] = Waiting([nan] * count, [None] * count, count)
        waiting.values[index] = value
        waiting.numbers[index] = sequence
        waiting.missing -= 1
        if len(pending) > 1:
            return rows + self._release()
        if not waiting.missing and self._may_leave(waiting):
            rows.append(self._leave(time_ns))
        return rows

    def flush(self) -> list[Row]:
        """Let everything leave that still waits, as at the end of a record."""
        return [self._leave(time_ns) for time_ns in sorted(self.state.pending)]

    def _has_come(self, index: int, time_ns: int) -> bool:
        """Whether a sample of that signal and that time came before."""
        waiting = self.state.pending.get(time_ns)
        numbers = waiting.numbers if waiting is not None else self.state.left.get(time_ns)
        return numbers is not None and numbers[index] is not None

    def _release(self) -> list[Row]:
        pending = self.state.pending
        rows: list[Row] = []
        times = sorted(pending)
        for position, time_ns in enumerate(times):
            newer = len(times) - 1 - position
            if newer < self._reorder_rows and not self._may_leave(pending[time_ns]):
                break
            rows.append(self._leave(time_ns))
        return rows

    def _may_leave(self, waiting: Waiting) -> bool:
        """Whether a row is complete, and follows by any of its numbers the row that left last."""
        if waiting.missing:
            return False
        for before, number in zip(self.state.newest_numbers, waiting.numbers, strict=True):
            if before is None or number == before + 1:
                return True
        return False

    def _leave(self, time_ns: int) -> Row:
        state = self.state
        waiting = state.pending.pop(time_ns)
        numbers, left = waiting.numbers, state.left
        left[time_ns] = numbers
        if len(left) > REMEMBERED * self._reorder_rows:
            del left[next(iter(left))]
        if waiting.missing:
            state.counts.incomplete_rows += 1
            pairs = zip(state.newest_numbers, numbers, strict=True)
            numbers = [before + 1 if number is None and before is not None else number for before, number in pairs]
        state.newest_left_ns, state.newest_numbers = time_ns, numbers
        state.counts.rows += 1
        row = Row(time_ns, tuple(waiting.values), state.restarted)
        state.restarted = False
        return row

    def _restart(self, index: int, time_ns: int, sequence: int) -> list[Row]:
        """If the publisher was restarted, begin anew; returns the rows that were waiting."""
        position = self.state.sequences[index]
        if position.expected is None:
            return []
        ahead = sequence >= position.expected
        set_back = ahead and time_ns < position.newest_ns  # a late sample has an old number, too
        fell_back = sequence < position.expected - REMEMBERED * self._reorder_rows
        began_again = not ahead and sequence == 0 and time_ns > position.newest_ns
        if not (set_back or fell_back or began_again):
            return []
        rows = self.flush()
        self.state.counts.restarts += 1
        self._begin()
        return rows

    def _begin(self) -> None:
        """Begin a new run of the publisher."""
        state = self.state
        state.left, state.newest_left_ns, state.newest_numbers = {}, None, [None] * self._count
        state.sequences, state.restarted = [Sequence() for _ in range(self._count)], True

    def _count_sequence(self, position: Sequence, time_ns: int, sequence: int) -> None:
        counts = self.state.counts
        if position.expected is None:
            position.expected, position.newest_ns = sequence + 1, time_ns
        elif sequence >= position.expected:
            counts.lost = min(counts.lost + sequence - position.expected, MOST_LOST)
            position.expected = sequence + 1
        elif time_ns < position.newest_ns:
            counts.out_of_order += 1
            counts.lost -= 1 if counts.lost else 0  # it was counted when it was overtaken
        position.newest_ns = max(position.newest_ns, time_ns)
