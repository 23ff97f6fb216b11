"""Gap tracker: position in one numbered stream, and the numbers missing before it. Pure: no clock, no I/O.

A publisher counts what it publishes, and within one run its times increase with the numbers. Delivery follows the
messages of a stream; monitor and recorder follow the samples of a signal. Each of them decides by rules of its own when
a stream starts again: see ADR 10.
"""

from bisect import bisect_right
from dataclasses import dataclass, field
from operator import itemgetter
from typing import ClassVar


@dataclass(slots=True)
class GapTracker:
    """Position in a numbered stream; the object is its own state.

    Attributes:
        max_gaps: number of gaps that are remembered; beyond it the oldest is dropped. A subclass sets it.
        expected: number after the highest so far; None before the first.
        newest_ns: time of the highest number; 0 before the first, and in a stream without times.
        gaps: first and last number of each range that is missing, increasing.

    >>> class Tracker(GapTracker):
    ...     max_gaps = 256
    >>> tracker = Tracker()
    >>> [tracker.advance(number, 100 * number) for number in (7, 8, 12)]
    [0, 0, 3]
    >>> tracker.fill(10), tracker.fill(10), tracker.gaps
    (True, False, [(9, 9), (11, 11)])
    """

    max_gaps: ClassVar[int] = 0

    expected: int | None = None
    newest_ns: int = 0
    gaps: list[tuple[int, int]] = field(default_factory=list)

    @property
    def newest(self) -> int | None:
        """The highest number so far; None before the first."""
        return None if self.expected is None else self.expected - 1

    def accept_next(self, number: int, time_ns: int) -> bool:
        """Move to the expected number, at a later time than the newest; False: it is not that one. The usual case."""
        if number != self.expected or time_ns <= self.newest_ns:
            return False
        self.expected, self.newest_ns = number + 1, time_ns
        return True

    def is_past(self, number: int, time_ns: int) -> bool:
        """True if neither number nor time is beyond the newest."""
        return self.expected is not None and number < self.expected and time_ns <= self.newest_ns

    def advance(self, number: int, time_ns: int = 0) -> int:
        """Make a number the newest; returns how many numbers it skips."""
        expected = self.expected
        self.expected, self.newest_ns = number + 1, time_ns
        if expected is None or number <= expected:
            return 0
        if self.max_gaps:
            self.gaps.append((expected, number - 1))
            del self.gaps[: -self.max_gaps]
        return number - expected

    def fill(self, number: int) -> bool:
        """Remove a number that arrived late from its gap; False if it is in none."""
        index = bisect_right(self.gaps, number, key=itemgetter(0)) - 1
        if index < 0 or number > self.gaps[index][1]:
            return False
        first, last = self.gaps[index]
        parts = ((first, number - 1), (number + 1, last))
        self.gaps[index : index + 1] = [part for part in parts if part[0] <= part[1]]
        return True
