"""Samples that came before: those of the rows that an aligner has, and those that a resumed monitor has processed.

A repeated sample is counted as duplicated and dropped.
"""

from dataclasses import replace

from msgspec import field

from reactorwatch.runtime.gap_tracker import GapTracker
from reactorwatch.stored_state import Memory


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

    Args:
        memory: memory of the alignment as stored.

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
        """True if a sample was processed before.

        Args:
            index: index of the signal in the rows.
            time_ns: sample time.
            sequence: sequence number.
        """
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
