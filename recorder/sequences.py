"""What the sequence numbers of one signal say about what never came.

A publisher counts its samples from 0. A number that is skipped is lost, until it comes after all: then it was only
out of order. A number that came before is a duplicate, unless its sample is younger than all others: then the
publisher was started anew and counts from 0 again. What was published before the first sample seen is not missed:
nobody was listening yet.
"""

from dataclasses import dataclass, field

MOST_GAPS = 256  # remembered a signal; a number that comes later than that is counted as a duplicate


@dataclass
class SequenceCheck:
    """The count of one signal's samples.

    Attributes:
        lost: samples that never came.
        duplicated: samples that came again.
        out_of_order: samples that came after a later one.
    """

    lost: int = 0
    duplicated: int = 0
    out_of_order: int = 0
    _next: int | None = None
    _newest_ns: int = 0
    _gaps: list[tuple[int, int]] = field(default_factory=list)  # (first, last) of each run of missing numbers

    def update(self, sequence: int, time_ns: int) -> None:
        """Count one sample."""
        if sequence == self._next:
            self._next = sequence + 1
            self._newest_ns = max(self._newest_ns, time_ns)
        elif self._next is None:
            self._next, self._newest_ns = sequence + 1, time_ns
        elif sequence > self._next:
            self._skip(self._next, sequence)
            self._newest_ns = max(self._newest_ns, time_ns)
        elif time_ns > self._newest_ns:
            self._gaps.clear()
            self._skip(0, sequence)
            self._newest_ns = time_ns
        elif self._fill(sequence):
            self.out_of_order += 1
            self.lost -= 1
        else:
            self.duplicated += 1

    def _skip(self, expected: int, sequence: int) -> None:
        self._next = sequence + 1
        if sequence > expected:
            self.lost += sequence - expected
            self._gaps.append((expected, sequence - 1))
            del self._gaps[:-MOST_GAPS]

    def _fill(self, sequence: int) -> bool:
        for place, (first, last) in enumerate(self._gaps):
            if first <= sequence <= last:
                rest = [(first, sequence - 1), (sequence + 1, last)]
                self._gaps[place : place + 1] = [gap for gap in rest if gap[0] <= gap[1]]
                return True
        return False
