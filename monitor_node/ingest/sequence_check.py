"""Which samples of a signal are of the plant that is being watched, told by their numbers and times alone.

A plant counts the samples of each signal, and its clock goes on as it counts. So a sample *follows* another if the time
between them, for each number between them, is within a quarter of the usual spacing, and four times the mean deviation
from it where spacings differ; a late one follows backwards, as far as rows are remembered. A sample that does not
follow is of another plant of the same name, or of somebody who plays with the bus, or damaged; or the plant was started
anew, its clock was set, or it paused. One sample does not tell which, but the next ones do:

- It is held back. As soon as one comes that follows the run as it was, the held ones are refused, but for those between
  the two in number and time: nothing was wrong with them but how soon they came.
- Two with the very numbers that come next, at later times, are of the run: the plant has paused. So are three with
  these numbers at other times, as evenly spaced as the run was: its clock was set.
- Eight that go on from each other, as evenly as the run did, without any of it between them, are the run from now on:
  the plant was started anew. (Fewer where rows wait for fewer others: those of one signal must find the others'.)

None of these is lost: a pause costs a delay of one sample, a clock that was set one of two, a plant that begins anew
one of seven; and of two plants with one name the first is watched on as long as its samples keep coming. What is
decided depends on the samples alone, so a replay decides the same.

The limit of that: where the first of two plants is held up, by a busy machine, while eight samples of the second come,
the second is watched, and the first refused when it is back. Until then all that a sample holds, and a recording of it,
is the same as after a restart of the first. Its liveliness token does not tell: both plants show the same, recordings
hold none, and that of a killed plant may outlast it by a lease of ten seconds. A larger `CONFIRMED` would only trade
longer stalls for a later start after each restart. To tell the two apart at once, a sample would have to name the
process that published it.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

from monitor_node.ingest.alignment import REMEMBERED

CONFIRMED, COUNTED = 8, 3
"""So many samples that go on from each other are the run: of any numbers, and of those that come next by their count.
What one publisher says may be held up, and another's come in a bunch meanwhile, so a few of any numbers say little."""

TOLERANCE, DEVIATIONS = 0.25, 4.0
"""Of the usual spacing, and mean deviations from it."""

MEMORY = 16
"""Spacings over which the usual one is forgotten, and that must be known before it is told how even they are."""

AT_FIRST = 4.0
"""Times the usual spacing, up to which it may be before that is known."""

ALIKE = 0.01
"""Of the usual spacing: a sample that is off by less is as usual, and teaches nothing."""


class Held(NamedTuple):
    """A sample that waits: when it was taken, its number, value and unit."""

    time_ns: int
    number: int
    value: float
    unit: str


@dataclass(slots=True)
class SampleRun:
    """The run of one signal; all of it is its state.

    Attributes:
        number: of the newest sample; None before the first.
        time_ns: of the newest sample.
        spacing_ns: as it usually is; 0 before it is known.
        deviation_ns: from it, in the mean.
        spacings: that these were learned from, up to `MEMORY`.
        held: samples that wait for the next ones.
    """

    number: int | None = None
    time_ns: int = 0
    spacing_ns: float = 0.0
    deviation_ns: float = 0.0
    spacings: int = 0
    held: list[Held] = field(default_factory=list)

    def goes_on(self, time_ns: int, number: int) -> bool:
        """Take in the sample that comes next, if it is that, and comes when it usually does; whether it was taken."""
        if self.held or number - 1 != self.number:
            return False
        if self.spacings < MEMORY or abs(time_ns - self.time_ns - self.spacing_ns) > ALIKE * self.spacing_ns:
            return False
        self.number, self.time_ns = number, time_ns
        return True

    def take(self, sample: Held, reorder_rows: int) -> tuple[list[Held], list[Held]]:
        """Take a sample in; returns those that are of the run, and those that are refused.

        Args:
            sample: that came.
            reorder_rows: of the alignment: how many newer rows one waits for.
        """
        held, window = self.held, REMEMBERED * reorder_rows
        follows = self._follows(sample, window)
        if not held:
            if follows:
                self._go_on(sample)
                return [sample], []
            self.held = [sample]
            return [], []
        self.held = []
        if follows:
            between = [item for item in held if self._is_between(item, sample)]
            for item in (*between, sample):
                self._go_on(item)
            return [*between, sample], [item for item in held if item not in between]
        held.append(sample)
        if self._counts_on(held):
            for item in held:
                self._go_on(item)
            return held, []
        if not self._is_run(held, window):
            self.held = [sample]
            return [], held[:-1]
        confirmed = COUNTED if self._are_next(held) else max(COUNTED, min(CONFIRMED, reorder_rows))
        if len(held) < confirmed:
            self.held = held
            return [], []
        self.number, self.spacing_ns, self.deviation_ns, self.spacings = None, 0.0, 0.0, 0
        for item in held:
            self._go_on(item)
        return held, []

    def released(self) -> list[Held]:
        """The held ones, at the end of a record: nothing contradicts them."""
        held, self.held = self.held, []
        return held

    def _counts_on(self, held: list[Held]) -> bool:
        """Whether samples have the very numbers that come next, and times that increase: the plant has paused."""
        times_ns = [self.time_ns, *(item.time_ns for item in held)]
        return self._are_next(held) and all(before < after for before, after in pairwise(times_ns))

    def _are_next(self, held: list[Held]) -> bool:
        """Whether samples have the very numbers that come next."""
        return self.number is not None and all(
            item.number == self.number + place for place, item in enumerate(held, start=1)
        )

    def _is_run(self, held: list[Held], window: int) -> bool:
        """Whether samples go on from each other, by spacings that are as like as those of the run."""
        pairs = [(item.number - last.number, item.time_ns - last.time_ns) for last, item in pairwise(held)]
        if any(abs(numbers) > window or numbers * time_ns <= 0 for numbers, time_ns in pairs):
            return False
        if self.spacings < MEMORY:
            return True
        unlike = TOLERANCE + DEVIATIONS * self.deviation_ns / self.spacing_ns
        spacings = [time_ns / numbers for numbers, time_ns in pairs]
        return max(spacings) - min(spacings) <= unlike * max(spacings)

    def _is_between(self, item: Held, sample: Held) -> bool:
        """Whether number and time of an item are between the newest of the run and a sample."""
        newest = self.number if self.number is not None else item.number
        return newest < item.number < sample.number and self.time_ns < item.time_ns < sample.time_ns

    def _go_on(self, sample: Held) -> None:
        if self.number is None or sample.number > self.number:
            if self.number is not None:
                self._learn((sample.time_ns - self.time_ns) / (sample.number - self.number))
            self.number, self.time_ns = sample.number, sample.time_ns

    def _learn(self, spacing_ns: float) -> None:
        if spacing_ns <= 0.0:
            return
        self.spacings = min(self.spacings + 1, MEMORY)
        off = spacing_ns - self.spacing_ns
        self.spacing_ns += off / self.spacings
        if self.spacings > 1:
            self.deviation_ns += (abs(off) - self.deviation_ns) / self.spacings

    def _follows(self, sample: Held, window: int) -> bool:
        """Whether a sample follows the newest of the run."""
        if self.number is None:
            return True
        numbers, time_ns = sample.number - self.number, sample.time_ns - self.time_ns
        if not numbers:
            return not time_ns
        if numbers < -window or time_ns * numbers <= 0:
            return False
        spacing_ns = time_ns / numbers
        if self.spacings < MEMORY:
            return not self.spacings or spacing_ns <= AT_FIRST * self.spacing_ns
        off = abs(spacing_ns - self.spacing_ns)
        return off <= TOLERANCE * self.spacing_ns + DEVIATIONS * self.deviation_ns
