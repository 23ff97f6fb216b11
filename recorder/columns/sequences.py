"""Sequence numbers of one signal: samples that are missing, and where a new run of the publisher starts. Pure.

A publisher counts its samples from 0, and within a run its sample times increase with their numbers. A number that is
skipped is lost, until its sample arrives late: then it was only out of order. A number and time that were seen before
are a duplicate. A sample whose number and time contradict those seen before starts a new run: the publisher was
restarted and counts from 0 again, or its clock was set back and it counts on. If the next sample after a single one
follows those before it, the single one was out of place: a damaged stamp and no run. What was published before the
first sample seen is not missing: nothing was recorded yet.
"""

from bisect import bisect_left
from dataclasses import dataclass, field
from enum import Enum

MOST_GAPS = 256  # remembered a signal; a number that comes later than that is counted as a duplicate
MOST_POINTS = 256
"""Numbers whose times are remembered. Beyond that, of the older half every second one is forgotten."""

LEAST_SPACING, LARGEST_SPACING = 0.75, 4.0
"""Of the usual spacing: within these, a sample follows those before one that is out of place."""


class Place(Enum):
    """Where a sample belongs."""

    IN_RUN = "in the run"
    STARTS_RUN = "it is the first of a new run"
    AFTER_STRAY = "in the run of those before the last sample, which was out of place"


@dataclass(slots=True)
class _Numbering:
    """One run of the publisher.

    Attributes:
        next: the number after that of the newest sample.
        newest_ns: time of the sample with the highest number.
        lowest: the lowest number that a sample of the run can have.
        gaps: (first, last) of each run of missing numbers.
        points: (number, time) of samples, increasing.
    """

    next: int
    newest_ns: int
    lowest: int = 0
    gaps: list[tuple[int, int]] = field(default_factory=list)
    points: list[tuple[int, int]] = field(default_factory=list)

    def advance(self, sequence: int, time_ns: int) -> None:
        """Take in the newest sample."""
        self.next, self.newest_ns = sequence + 1, time_ns
        self.points.append((sequence, time_ns))
        if len(self.points) > MOST_POINTS:
            del self.points[1 : MOST_POINTS // 2 : 2]

    def agrees(self, sequence: int, time_ns: int) -> bool:
        """Whether an older number has a time that it can have had in this run."""
        if sequence < self.lowest:
            return False
        after = bisect_left(self.points, (sequence, time_ns))
        if after < len(self.points) and self.points[after][0] == sequence:
            return self.points[after][1] == time_ns
        if after > 0 and not (self.points[after - 1][0] < sequence and self.points[after - 1][1] < time_ns):
            return False
        return after == len(self.points) or time_ns < self.points[after][1]

    def fill(self, sequence: int) -> bool:
        """Whether a number was missing; it is no longer."""
        for place, (first, last) in enumerate(self.gaps):
            if first <= sequence <= last:
                rest = [(first, sequence - 1), (sequence + 1, last)]
                self.gaps[place : place + 1] = [gap for gap in rest if gap[0] <= gap[1]]
                return True
        return False


@dataclass(slots=True)
class _Before:
    """How things were before the newest sample.

    Attributes:
        run: that the sample before it was of.
        next: of that run.
        newest_ns: of that run.
        lost: of the check.
        gaps: how many the run had.
    """

    run: _Numbering
    next: int
    newest_ns: int
    lost: int
    gaps: int


@dataclass
class SequenceCheck:
    """The count of one signal's samples.

    Attributes:
        lost: samples that never came.
        duplicated: samples that came again.
        out_of_order: samples that came after a later one.
        out_of_place: samples with a number or a time that fit neither those before nor those after.
    """

    lost: int = 0
    duplicated: int = 0
    out_of_order: int = 0
    out_of_place: int = 0
    _run: _Numbering | None = None
    _before: _Before | None = None

    @property
    def newest_ns(self) -> int:
        """Time of the sample with the highest number in this run; 0 before the first."""
        return self._run.newest_ns if self._run is not None else 0

    def update(self, sequence: int, time_ns: int) -> Place:
        """Count one sample."""
        run = self._run
        if run is None:
            run = self._run = _Numbering(sequence, time_ns)
            run.advance(sequence, time_ns)
            return Place.IN_RUN
        if sequence == run.next and time_ns > run.newest_ns and len(run.points) > 1:
            self._before = None  # it is known from the points
            run.advance(sequence, time_ns)
            return Place.IN_RUN
        if self._before is None and len(run.points) > 1:
            number, then_ns = run.points[-2]
            self._before = _Before(run, number + 1, then_ns, self.lost, len(run.gaps))
        if not self._continues(run, sequence, time_ns) and self._follows_before(sequence, time_ns):
            self._forget_stray()
            self.update(sequence, time_ns)
            return Place.AFTER_STRAY
        return self._judge(run, sequence, time_ns)

    def _continues(self, run: _Numbering, sequence: int, time_ns: int) -> bool:
        """Whether a sample can be of the run, which is not a single sample that started a run."""
        if self._before is not None and self._before.run is not run:
            return False
        return time_ns > run.newest_ns if sequence >= run.next else run.agrees(sequence, time_ns)

    def _judge(self, run: _Numbering, sequence: int, time_ns: int) -> Place:
        before = _Before(run, run.next, run.newest_ns, self.lost, len(run.gaps))
        if sequence >= run.next and time_ns > run.newest_ns:
            self._skip(run, run.next, sequence)
        elif sequence == 0 and run.next == 1 and time_ns > run.newest_ns:  # the publisher does not count
            run.points.clear()
        elif sequence < run.next and run.agrees(sequence, time_ns):
            filled = run.fill(sequence)
            self.out_of_order += filled
            self.lost -= filled
            self.duplicated += not filled
            return Place.IN_RUN
        else:
            expected = run.next if sequence >= run.next else 0
            self._run = run = _Numbering(sequence, time_ns, lowest=expected)
            self._skip(run, expected, sequence)
        self._before = before
        run.advance(sequence, time_ns)
        return Place.IN_RUN if run is before.run else Place.STARTS_RUN

    def _follows_before(self, sequence: int, time_ns: int) -> bool:
        """Whether a sample follows those before the newest one as if that had not been."""
        before = self._before
        if before is None or sequence < before.next or time_ns <= before.newest_ns:
            return False
        points = before.run.points[:-1] if before.run is self._run else before.run.points
        if len(points) < 2:
            return False
        (number, then_ns), (last, last_ns) = points[-2:]
        usual_ns = (last_ns - then_ns) / (last - number)
        spacing_ns = (time_ns - before.newest_ns) / (sequence - before.next + 1)
        return LEAST_SPACING * usual_ns <= spacing_ns <= LARGEST_SPACING * usual_ns

    def _forget_stray(self) -> None:
        """Go back to before the newest sample, which was out of place."""
        before, run = self._before, self._run
        assert before is not None
        assert run is not None
        stray = run.next - 1
        if before.run is run:
            run.points.pop()
            del run.gaps[before.gaps :]
        # Where the stray has the very number that comes next, it is not missing.
        before.run.next = before.next + (stray == before.next)
        before.run.newest_ns = before.newest_ns
        self._run, self._before, self.lost = before.run, None, before.lost
        self.out_of_place += 1

    def _skip(self, run: _Numbering, expected: int, sequence: int) -> None:
        if sequence > expected:
            self.lost += sequence - expected
            run.gaps.append((expected, sequence - 1))
            del run.gaps[:-MOST_GAPS]
