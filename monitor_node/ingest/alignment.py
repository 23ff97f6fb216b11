"""Align samples of single signals to rows by sample time.

The policy uses sample times alone, so that a replay reproduces the live run exactly:

- A row is emitted when it is complete and no older row is pending. Pending are incomplete rows, and rows that are
  missing by their sequence numbers.
- A row is pending until `reorder_rows` newer rows have started. Then it is emitted with NaN for missing values, and
  counted as incomplete.
- A sample of an emitted row is late: counted and dropped. The same sample twice is a duplicate, counted and dropped.
- A sample older than the newest of its signal is out of order: counted, and used if its row is pending.
- A forward jump of sequence numbers means lost samples, until they arrive. A step back by more than reordering can
  explain means a restart of the publisher: pending rows are emitted, and a new run starts.
"""

from math import nan

from monitor_node.ingest.duplicates import AlignmentMemory, PendingRow
from monitor_node.ingest.rows import Row
from reactorwatch.runtime.gap_tracker import GapTracker

REMEMBERED = 4  # times the reordering: emitted rows kept to detect duplicates; step back that means a restart
MOST_LOST = 2**62  # more than any plant publishes; corrupt sequence numbers must not overflow the count in a message


class Aligner:
    """Aligns samples to rows.

    Args:
        signals: names of the signals, in the order of the rows' values.
        reorder_rows: number of newer rows that may start before an incomplete row is emitted.

    Raises:
        ValueError: `reorder_rows` is less than 1.
    """

    def __init__(self, signals: tuple[str, ...], reorder_rows: int) -> None:
        if reorder_rows < 1:
            raise ValueError(f"reorder_rows must be at least 1, got {reorder_rows}")
        self._index = {signal: index for index, signal in enumerate(signals)}
        self._count = len(signals)
        self._reorder_rows = reorder_rows
        self.memory = AlignmentMemory()
        self._start_run()

    def update(self, signal: str, time_ns: int, sequence: int, value: float) -> list[Row]:
        """Add a sample; returns the rows that are ready, oldest first.

        Args:
            signal: one of the aligner's signals.
            time_ns: sample time.
            sequence: sequence number.
            value: finite value.
        """
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
            if newer < self._reorder_rows and not self._is_ready(pending[time_ns]):
                break
            rows.append(self._emit(time_ns))
        return rows

    def _is_ready(self, waiting: PendingRow) -> bool:
        """True if a row is complete, and follows the row emitted last by any of its sequence numbers."""
        if waiting.missing:
            return False
        for before, number in zip(self.memory.newest_numbers, waiting.numbers, strict=True):
            if before is None or number == before + 1:
                return True
        return False

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
            counts.lost = min(counts.lost + position.advance(sequence, time_ns), MOST_LOST)
        elif time_ns < position.newest_ns:
            counts.out_of_order += 1
            counts.lost -= 1 if counts.lost else 0  # it was counted when it was overtaken
        else:
            position.newest_ns = time_ns
