"""Rows of samples: aligned by sample time, their sampling period, and the interval between a row and its predecessor.

The period is fixed once it is learned, because the models of the training hold for one period; so it is the median of
the first intervals. The `Spacing` of a signal's samples (`spc.silence`) follows a plant that slows down.

A row *follows* if it is one sampling period after its predecessor, to a tenth: a linear model of lagged samples holds
only then. A *gap* is more than two and a half periods, or a step back in time: the rows before it are then too old to
tell chance from change.

Samples are aligned by sample times alone, so that a replay reproduces the live run exactly:

- A row is emitted when it is complete and no older row is pending. Pending are incomplete rows, and rows that are
  missing by their sequence numbers.
- A row is pending until `reorder_rows` newer rows have started. Then it is emitted with NaN for missing values, and
  counted as incomplete. A row that lacks only signals which most rows lack, as a laboratory's, waits for one newer row.
- A sample of an emitted row is late: counted and dropped. The same sample twice is a duplicate, counted and dropped.
- A sample older than the newest of its signal is out of order: counted, and used if its row is pending.
- A forward jump of sequence numbers means lost samples, until they arrive. A step back by more than reordering can
  explain means a restart of the publisher: pending rows are emitted, and a new run starts.
"""

from dataclasses import dataclass, replace
from math import nan
from statistics import median
from typing import NamedTuple

import numpy as np
from msgspec import field
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Publication
from reactorwatch.runtime.gap_tracker import GapTracker
from reactorwatch.stored_state import Memory

LEARN_FROM = 32  # spacings
TOLERANCE = 0.1  # of the period
WHOLE = 0.25  # of a period: tolerance of an interval of several whole periods, in which rows are missing


class Row(NamedTuple):
    """Measured values of one time.

    Attributes:
        time_ns: sample time.
        values: one value a signal, in the order of the aligner's signals; NaN if missing.
        restarted: True for the first row of a new run of the publisher.
    """

    time_ns: int
    values: tuple[float, ...]
    restarted: bool


class Interval(NamedTuple):
    """Interval between a row and its predecessor.

    Attributes:
        follows: True if it is one sampling period.
        is_gap: True if it is a gap.
        missing: number of rows that are missing in it, by its length.
    """

    follows: bool
    is_gap: bool
    missing: int


NO_INTERVAL, ONE_PERIOD = Interval(False, False, 0), Interval(True, False, 0)


@dataclass(slots=True)
class MeasuredRow:
    """A row on its way through the stages of the pipeline.

    Attributes:
        time_ns: sample time.
        inputs: one value an input; NaN if missing.
        values: one value an output; NaN if missing, or if the signal checks found that it is no measurement.
        units: units of the outputs.
        interval: interval before the row.
        follows: True if the row is one sampling period after its predecessor in the same run.
        publications: publications because of the row so far.
    """

    time_ns: int
    inputs: tuple[float, ...]
    values: list[float]
    units: list[str]
    interval: Interval
    follows: bool
    publications: list[Publication]


class SamplingPeriod(Memory):
    """Sampling period, learned from the first rows; the object is its own state.

    Before it is learned, a row follows within 1.5 times the shortest interval so far.

    Attributes:
        last_ns: time of the last row; None before the first.
        spacings_ns: intervals from which the period is learned.
        learned_ns: sampling period; None before it is learned.
        spacing_ns: interval before the last row; None before the second.
    """

    last_ns: int | None = None
    spacings_ns: list[int] = field(default_factory=list)
    learned_ns: float | None = None
    spacing_ns: int | None = None

    def update(self, time_ns: int) -> Interval:
        """Update with a row; returns the interval before it."""
        last, self.last_ns = self.last_ns, time_ns
        if last is None:
            return NO_INTERVAL
        spacing = self.spacing_ns = time_ns - last
        if spacing == self.learned_ns:  # as mostly
            return ONE_PERIOD
        if spacing <= 0:
            return Interval(False, True, 0)
        if self.learned_ns is None:
            self.spacings_ns.append(spacing)
            if len(self.spacings_ns) == LEARN_FROM:
                self.learned_ns = float(median(self.spacings_ns))
            follows = spacing <= 1.5 * min(self.spacings_ns)
        else:
            follows = abs(spacing - self.learned_ns) <= TOLERANCE * self.learned_ns
        missing = 0 if self.learned_ns is None else missing_rows(spacing / self.learned_ns)
        return Interval(follows, spacing > 2.5 * self.period_ns, missing)

    @property
    def period_ns(self) -> float:
        """Sampling period; before it is learned, the shortest interval so far; 0 before the second row."""
        return self.learned_ns if self.learned_ns is not None else float(min(self.spacings_ns, default=0))


def missing_rows(periods: float) -> int:
    """Number of rows missing between two rows that are `periods` sampling periods apart.

    With irregular rows, an interval that is no whole number of periods is no evidence of a lost row.

    >>> [missing_rows(periods) for periods in (0.9, 1.4, 2.0, 2.4, 3.1)]
    [0, 0, 1, 0, 2]
    """
    whole = round(periods)
    return whole - 1 if whole > 1 and abs(periods - whole) <= WHOLE else 0


def regular_intervals(time_min: Array) -> NDArray[np.bool_]:
    """Flags of the intervals that are one sampling period, the median interval, to a tenth; shape (rows - 1,)."""
    spacings = np.diff(time_min)
    period = np.median(spacings) if spacings.size else 0.0
    return np.abs(spacings - period) <= TOLERANCE * period


def missing_in_intervals(time_min: Array) -> NDArray[np.intp]:
    """Numbers of rows missing in the intervals of a record, by its median interval, shape (n - 1,).

    >>> missing_in_intervals(np.array([0.0, 1.0, 2.0, 4.0, 5.0])).tolist()
    [0, 0, 1, 0]
    """
    spacings = np.diff(time_min)
    periods = spacings / (np.median(spacings) if spacings.size else 1.0)
    return np.array([missing_rows(item) for item in periods.tolist()], dtype=np.intp)


class Counts(Memory):
    """Counts of samples and rows by what happened to them."""

    rows: int = 0
    incomplete_rows: int = 0
    late: int = 0
    duplicated: int = 0
    out_of_order: int = 0
    lost: int = 0
    restarts: int = 0


class PendingRow(Memory):
    """A row that is not emitted yet.

    Attributes:
        values: one value a signal; NaN where not received.
        numbers: sequence number of each value; None where not received.
        missing: number of values not received.
    """

    values: list[float]
    numbers: list[int | None]
    missing: int


class AlignmentMemory(Memory):
    """Memory of an aligner.

    Attributes:
        pending: pending rows by time.
        emitted: sequence numbers of the rows emitted last, by time, oldest first; None where a sample was missing.
        newest_emitted_ns: time of the row emitted last; None before the first.
        newest_numbers: sequence numbers of that row, extrapolated where missing; None before the first.
        sequences: position in the run of each signal.
        restarted: True if the next row is the first of a new run.
        counts: counts so far.
    """

    pending: dict[int, PendingRow] = field(default_factory=dict)
    emitted: dict[int, list[int | None]] = field(default_factory=dict)
    newest_emitted_ns: int | None = None
    newest_numbers: list[int | None] = field(default_factory=list)
    sequences: list[GapTracker] = field(default_factory=list)
    restarted: bool = True
    counts: Counts = field(default_factory=Counts)

    def has_sample(self, index: int, time_ns: int) -> bool:
        """True if a sample of that signal and time is in a pending row, or in one of those emitted last."""
        pending = self.pending.get(time_ns)
        numbers = pending.numbers if pending is not None else self.emitted.get(time_ns)
        return numbers is not None and numbers[index] is not None


class ReplayFilter:
    """Filter of samples that were processed before a restart.

    A resumed monitor queries the history of its plant. It starts with samples that the stored state includes, followed
    by those since the state was stored. A plant numbers the samples of each signal. So a sample was processed before

    - if the state has the row of its time, with this sequence number of the signal; or
    - if its row is older than any in the state, and neither its number nor its time is beyond the newest.

    The sample that follows the newest ends the filter for its signal; one farther on does not, as another publisher may
    have sent it before the history came. So does one with another number than the state has for its time: then the
    plant was restarted with its clock set back. A sample that is missing in its row of the state was not processed, and
    passes.

    Attributes:
        has_begun: True if a sample has come.
    """

    def __init__(self, memory: AlignmentMemory) -> None:
        self.has_begun = False
        self._newest: list[GapTracker | None] = [
            None if item.expected is None else replace(item) for item in memory.sequences
        ]
        self._unfinished = sum(item is not None for item in self._newest)
        waiting = {time_ns: row.numbers for time_ns, row in memory.pending.items()}
        self._numbers = {time_ns: list(numbers) for time_ns, numbers in (memory.emitted | waiting).items()}

    @property
    def is_over(self) -> bool:
        """True if no signal has a sample left to filter."""
        return not self._unfinished

    def is_duplicate(self, index: int, time_ns: int, sequence: int) -> bool:
        """True if a sample was processed before."""
        self.has_begun = True
        newest = self._newest[index]
        if newest is None:
            return False
        numbers = self._numbers.get(time_ns)
        if numbers is not None and numbers[index] is None:
            return False
        known = numbers is not None and numbers[index] == sequence
        older = numbers is None and newest.is_past(sequence, time_ns)
        if not (known or older) and (numbers is not None or sequence == newest.expected):
            self._newest[index] = None
            self._unfinished -= 1
        return known or older


REMEMBERED = 4  # times the reordering: emitted rows kept to detect duplicates; step back that means a restart


class Aligner:
    """Aligns samples to rows.

    Args:
        signals: names of the signals.
        reorder_rows: number of newer rows that may start before an incomplete row is emitted.
        awaits_all: True to wait so long for signals that most rows lack, too, as where each sample is a row of its own.

    Raises:
        ValueError: `reorder_rows` is less than 1.
    """

    def __init__(self, signals: tuple[str, ...], reorder_rows: int, *, awaits_all: bool = False) -> None:
        if reorder_rows < 1:
            raise ValueError(f"reorder_rows must be at least 1, got {reorder_rows}")
        self._index = {signal: index for index, signal in enumerate(signals)}
        self._count = len(signals)
        self._reorder_rows, self._awaits_all = reorder_rows, awaits_all
        self.memory = AlignmentMemory()
        self._start_run()

    def update(self, signal: str, time_ns: int, sequence: int, value: float) -> list[Row]:
        """Add a sample; returns the rows that are ready, oldest first."""
        rows: list[Row] = []
        index, memory = self._index[signal], self.memory
        position = memory.sequences[index]
        if not position.accept_next(sequence, time_ns):
            rows = self._restart(index, time_ns, sequence)
            if memory.has_sample(index, time_ns):
                memory.counts.duplicated += 1
                return rows
            self._count_sequence(memory.sequences[index], time_ns, sequence)
        pending = memory.pending
        waiting = pending.get(time_ns)
        if waiting is None:
            if memory.newest_emitted_ns is not None and time_ns <= memory.newest_emitted_ns:
                memory.counts.late += 1
                if (numbers := memory.emitted.get(time_ns)) is not None:
                    numbers[index] = sequence  # the signal is not one that the row lacked
                return rows
            count = self._count
            waiting = pending[time_ns] = PendingRow([nan] * count, [None] * count, count)
        waiting.values[index] = value
        waiting.numbers[index] = sequence
        waiting.missing -= 1
        if len(pending) > 1:
            return rows + self._release()
        if not waiting.missing and self._is_ready(waiting):
            rows.append(self._emit(time_ns))
        return rows

    def flush(self) -> list[Row]:
        """Emit all pending rows, as at the end of a record."""
        return [self._emit(time_ns) for time_ns in sorted(self.memory.pending)]

    def _release(self) -> list[Row]:
        pending = self.memory.pending
        rows: list[Row] = []
        times = sorted(pending)
        for position, time_ns in enumerate(times):
            newer = len(times) - 1 - position
            if newer < self._reorder_rows and not self._is_ready(pending[time_ns], has_newer=newer > 0):
                break
            rows.append(self._emit(time_ns))
        return rows

    def _is_ready(self, waiting: PendingRow, *, has_newer: bool = False) -> bool:
        """True if a row is complete, and follows the row emitted last by any of its sequence numbers."""
        if waiting.missing and not (has_newer and self._lacks_sparse_signals_only(waiting)):
            return False
        for before, number in zip(self.memory.newest_numbers, waiting.numbers, strict=True):
            if before is None or number == before + 1:
                return True
        return False

    def _lacks_sparse_signals_only(self, waiting: PendingRow) -> bool:
        """True if most of the rows emitted last lack each signal that a row lacks, and it did not come late either."""
        emitted = list(self.memory.emitted.values())
        if self._awaits_all or len(emitted) < REMEMBERED * self._reorder_rows:
            return False
        lacking = [2 * sum(row[index] is None for row in emitted) > len(emitted) for index in range(self._count)]
        return all(is_sparse for is_sparse, number in zip(lacking, waiting.numbers, strict=True) if number is None)

    def _emit(self, time_ns: int) -> Row:
        memory = self.memory
        waiting = memory.pending.pop(time_ns)
        numbers, emitted = waiting.numbers, memory.emitted
        emitted[time_ns] = numbers
        if len(emitted) > REMEMBERED * self._reorder_rows:
            del emitted[next(iter(emitted))]
        if waiting.missing:
            memory.counts.incomplete_rows += 1
            pairs = zip(memory.newest_numbers, numbers, strict=True)
            numbers = [before + 1 if number is None and before is not None else number for before, number in pairs]
        memory.newest_emitted_ns, memory.newest_numbers = time_ns, numbers
        memory.counts.rows += 1
        row = Row(time_ns, tuple(waiting.values), memory.restarted)
        memory.restarted = False
        return row

    def _restart(self, index: int, time_ns: int, sequence: int) -> list[Row]:
        """Start a new run if the publisher was restarted; returns the rows that were pending."""
        position = self.memory.sequences[index]
        if position.expected is None:
            return []
        ahead = sequence >= position.expected
        set_back = ahead and time_ns < position.newest_ns  # a late sample has an old number, too
        fell_back = sequence < position.expected - REMEMBERED * self._reorder_rows
        from_zero = not ahead and sequence == 0 and time_ns > position.newest_ns
        if not (set_back or fell_back or from_zero):
            return []
        rows = self.flush()
        self.memory.counts.restarts += 1
        self._start_run()
        return rows

    def _start_run(self) -> None:
        """Start a new run of the publisher."""
        memory = self.memory
        memory.emitted, memory.newest_emitted_ns, memory.newest_numbers = {}, None, [None] * self._count
        memory.sequences, memory.restarted = [GapTracker() for _ in range(self._count)], True

    def _count_sequence(self, position: GapTracker, time_ns: int, sequence: int) -> None:
        counts = self.memory.counts
        if position.expected is None or sequence >= position.expected:
            # more than any plant publishes; corrupt numbers must not overflow the count in a message
            counts.lost = min(counts.lost + position.advance(sequence, time_ns), 2**62)
        elif time_ns < position.newest_ns:
            counts.out_of_order += 1
            counts.lost -= 1 if counts.lost else 0  # it was counted when it was overtaken
        else:
            position.newest_ns = time_ns
