"""Count lost, duplicated and reordered samples of one signal, and detect new runs of its publisher. Pure.

A publisher counts its samples from 0, and within a run the sample times increase with the sequence numbers. A skipped
number is lost until its sample arrives late: then it is out of order. A repeated number and time are a duplicate. A
sample whose number and time contradict earlier ones starts a new run: the publisher was restarted and counts from 0
again, or its clock was set back and it continues to count. If the sample after it continues the earlier run instead,
the contradicting sample was a stray with a damaged stamp. Numbers before the first received sample are not lost.
"""

from bisect import bisect_left
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from reactorwatch.runtime.delivery.gap_tracker import GapTracker

MAX_GAPS = 256  # stored gaps of a signal; a late sample of an older gap is counted as a duplicate
MAX_POINTS = 256
"""Stored (number, time) points; beyond it every second one of the older half is dropped."""

MIN_SPACING, MAX_SPACING = 0.75, 4.0
"""Range of the spacing after a stray, in usual spacings, in which a sample continues the run before it."""


class RunTransition(Enum):
    """Relation of a sample to the run before it."""

    SAME_RUN = "continues the run"
    NEW_RUN = "first of a new run"
    AFTER_STRAY = "continues the run before the last sample, which was a stray"


@dataclass(slots=True)
class _PublisherRun(GapTracker):
    """One run of the publisher.

    Attributes:
        lowest: lowest possible number of the run.
        points: increasing (number, time) of samples.
    """

    max_gaps = MAX_GAPS

    lowest: int = 0
    points: list[tuple[int, int]] = field(default_factory=list)

    @property
    def next(self) -> int:
        """Expected number."""
        assert self.expected is not None
        return self.expected

    def accept_next(self, number: int, time_ns: int) -> bool:
        """See `GapTracker`; False also for the first two samples of a run. Written out: it runs for each sample."""
        points = self.points
        if number != self.expected or time_ns <= self.newest_ns or len(points) < 2:
            return False
        self.expected, self.newest_ns = number + 1, time_ns
        points.append((number, time_ns))
        if len(points) > MAX_POINTS:
            self._thin_out()
        return True

    def extend(self, points: list[tuple[int, int]]) -> None:
        """Call `accept_next` for (number, time) that it accepts, at once."""
        self.expected, self.newest_ns = points[-1][0] + 1, points[-1][1]
        at = 0
        while at < len(points):
            end = at + MAX_POINTS + 1 - len(self.points)
            self.points += points[at:end]
            at = end
            if len(self.points) > MAX_POINTS:
                self._thin_out()

    def advance(self, number: int, time_ns: int = 0) -> int:
        """Add the newest sample; returns how many were skipped."""
        self.points.append((number, time_ns))
        if len(self.points) > MAX_POINTS:
            self._thin_out()
        return GapTracker.advance(self, number, time_ns)

    def _thin_out(self) -> None:
        del self.points[1 : MAX_POINTS // 2 : 2]

    def is_consistent(self, sequence: int, time_ns: int) -> bool:
        """True if an older number can have this time in this run."""
        if sequence < self.lowest:
            return False
        after = bisect_left(self.points, (sequence, time_ns))
        if after < len(self.points) and self.points[after][0] == sequence:
            return self.points[after][1] == time_ns
        if after > 0 and not (self.points[after - 1][0] < sequence and self.points[after - 1][1] < time_ns):
            return False
        return after == len(self.points) or time_ns < self.points[after][1]


@dataclass(slots=True)
class _Checkpoint:
    """State before the newest sample, restored if that was a stray.

    Attributes:
        run: run of the sample before it.
        expected: expected number of that run.
        newest_ns: `newest_ns` of that run.
        lost: `lost` of the counter.
        gaps: number of gaps of that run.
    """

    run: _PublisherRun
    expected: int
    newest_ns: int
    lost: int
    gaps: int


@dataclass
class SequenceCounter:
    """Counts of one signal's samples.

    Attributes:
        lost: samples that were never received.
        duplicated: samples that were received again.
        out_of_order: samples that were received after a later one.
        out_of_place: strays: samples whose number and time fit neither those before nor those after.
    """

    lost: int = 0
    duplicated: int = 0
    out_of_order: int = 0
    out_of_place: int = 0
    _run: _PublisherRun | None = None
    _checkpoint: _Checkpoint | None = None

    @property
    def newest_ns(self) -> int:
        """Time of the sample with the highest number in this run; 0 before the first sample."""
        return self._run.newest_ns if self._run is not None else 0

    def update(self, sequence: int, time_ns: int) -> RunTransition:
        """Count one sample."""
        run = self._run
        if run is None:
            run = self._run = _PublisherRun()
            run.advance(sequence, time_ns)
            return RunTransition.SAME_RUN
        if run.accept_next(sequence, time_ns):
            self._checkpoint = None  # derived from the points when needed
            return RunTransition.SAME_RUN
        if self._checkpoint is None and len(run.points) > 1:
            number, then_ns = run.points[-2]
            self._checkpoint = _Checkpoint(run, number + 1, then_ns, self.lost, len(run.gaps))
        if not self._continues(run, sequence, time_ns) and self._follows_checkpoint(sequence, time_ns):
            self._roll_back()
            self.update(sequence, time_ns)
            return RunTransition.AFTER_STRAY
        return self._classify(run, sequence, time_ns)

    def continues(self, numbers: NDArray[np.int64], times_ns: NDArray[np.int64]) -> bool:
        """True if each of these samples is the next one of the run, as nearly always; at least one."""
        run = self._run
        if run is None or len(run.points) < 2 or numbers[0] != run.expected or times_ns[0] <= run.newest_ns:
            return False
        return bool((np.diff(numbers) == 1).all() and (np.diff(times_ns) > 0).all())

    def update_all(self, numbers: NDArray[np.int64], times_ns: NDArray[np.int64]) -> None:
        """Count samples of which `continues` is True, as `update` would count each."""
        assert self._run is not None, "it continues"
        self._run.extend(list(zip(numbers.tolist(), times_ns.tolist(), strict=True)))
        self._checkpoint = None

    def _continues(self, run: _PublisherRun, sequence: int, time_ns: int) -> bool:
        """True if a sample fits the run, unless the run consists of a single sample after another run."""
        if self._checkpoint is not None and self._checkpoint.run is not run:
            return False
        return time_ns > run.newest_ns if sequence >= run.next else run.is_consistent(sequence, time_ns)

    def _classify(self, run: _PublisherRun, sequence: int, time_ns: int) -> RunTransition:
        before = _Checkpoint(run, run.next, run.newest_ns, self.lost, len(run.gaps))
        if sequence == 0 and run.next == 1 and time_ns > run.newest_ns:  # the publisher does not count its samples
            run.points.clear()
        elif sequence < run.next and run.is_consistent(sequence, time_ns):
            filled = run.fill(sequence)
            self.out_of_order += filled
            self.lost -= filled
            self.duplicated += not filled
            return RunTransition.SAME_RUN
        elif sequence < run.next or time_ns <= run.newest_ns:
            expected = run.next if sequence >= run.next else 0
            self._run = run = _PublisherRun(expected, lowest=expected)
        self._checkpoint = before
        self.lost += run.advance(sequence, time_ns)
        return RunTransition.SAME_RUN if run is before.run else RunTransition.NEW_RUN

    def _follows_checkpoint(self, sequence: int, time_ns: int) -> bool:
        """True if a sample continues the run as if the newest sample had not been received."""
        before = self._checkpoint
        if before is None or sequence < before.expected or time_ns <= before.newest_ns:
            return False
        points = before.run.points[:-1] if before.run is self._run else before.run.points
        if len(points) < 2:
            return False
        (number, then_ns), (last, last_ns) = points[-2:]
        usual_ns = (last_ns - then_ns) / (last - number)
        spacing_ns = (time_ns - before.newest_ns) / (sequence - before.expected + 1)
        return MIN_SPACING * usual_ns <= spacing_ns <= MAX_SPACING * usual_ns

    def _roll_back(self) -> None:
        """Restore the state before the newest sample, which was a stray."""
        before, run = self._checkpoint, self._run
        assert before is not None
        assert run is not None
        stray = run.next - 1
        if before.run is run:
            run.points.pop()
            del run.gaps[before.gaps :]
        # A stray with the expected number is not lost.
        before.run.expected = before.expected + (stray == before.expected)
        before.run.newest_ns = before.newest_ns
        self._run, self._checkpoint, self.lost = before.run, None, before.lost
        self.out_of_place += 1
