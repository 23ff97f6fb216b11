"""Reject samples of another publisher of the same signal, by sequence numbers and times alone.

A plant numbers the samples of each signal, and its clock advances with the numbers. So a sample *follows* another if
the time between them, divided by the difference of their numbers, is within a quarter of the usual spacing plus four
mean deviations from it. A late sample follows backwards, as far as rows are remembered. A sample that does not follow
is corrupt, forged, or from another plant of the same name; or the plant was restarted, its clock was set, or it paused.
Only the next samples decide:

- The sample is held. When one arrives that follows the run, held samples are rejected, except those between the two in
  number and time, which only arrived early.
- Two samples with the next numbers, at later times, belong to the run: the plant has paused. So do three with these
  numbers at other times, as evenly spaced as the run: its clock was set.
- Eight samples that follow each other as evenly as the run, without any sample of it between them, are the new run: the
  plant was restarted. (Fewer with a smaller `reorder_rows`: the samples of one signal must meet the others' in rows.)

No sample is lost: a pause delays one sample, a clock that was set two, a restart seven. Of two plants with one name the
first is monitored as long as its samples arrive. The decision depends on the samples alone, so a replay decides the
same.

Limit: if the first of two plants stalls while eight samples of the second arrive, the second is monitored, and the
first is rejected when it resumes. Until then its samples, and a recording of them, look like a restart of the first.
Liveliness tokens do not help: both plants show the same, recordings hold none, and that of a killed plant may outlast
it by a lease of ten seconds. A larger `CONFIRMED` would only trade longer stalls for a later start after each restart.
To tell the two apart at once, a sample would have to name the process that published it.
"""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

from monitor_node.ingest.alignment import REMEMBERED
from reactorwatch.runtime.gap_tracker import GapTracker
from reactorwatch.spc.silence import Spacing

CONFIRMED, COUNTED = 8, 3
"""Samples that confirm a new run: with any numbers, and with the next numbers. One publisher's samples may be delayed
while another's arrive in a burst, so a few with any numbers are weak evidence."""

TOLERANCE, DEVIATIONS = 0.25, 4.0
"""Allowed deviation: share of the usual spacing, and mean deviations."""

MEMORY = 16
"""Spacings in the exponential mean, and needed before their evenness is checked."""


def is_alike(usual: Spacing, spacing_ns: float) -> bool:
    """True if the spacing of two samples, per number, may be of a run whose usual one, which must be known, is this."""
    deviation_ns = abs(spacing_ns - usual.mean_ns)
    return spacing_ns > 0.0 and deviation_ns <= TOLERANCE * usual.mean_ns + DEVIATIONS * usual.deviation_ns


class HeldSample(NamedTuple):
    """A held sample: time, sequence number, value and unit."""

    time_ns: int
    number: int
    value: float
    unit: str


@dataclass(slots=True)
class SequenceCheck(GapTracker):
    """The run of samples of one signal; the object is its own state.

    Attributes:
        spacing: usual spacing of the run, over `MEMORY` spacings.
        held: held samples.
    """

    spacing: Spacing = field(default_factory=Spacing)
    held: list[HeldSample] = field(default_factory=list)

    def accept_next(self, number: int, time_ns: int) -> bool:
        """Accept a sample that has the next number, and follows; returns True if it does. The usual case."""
        usual = self.spacing
        if self.held or number != self.expected or usual.count < MEMORY:
            return False
        spacing_ns = float(time_ns - self.newest_ns)
        if abs(spacing_ns - usual.mean_ns) > 0.01 * usual.mean_ns:
            if not is_alike(usual, spacing_ns):
                return False
            usual.learn(spacing_ns, MEMORY)
        self.expected, self.newest_ns = number + 1, time_ns
        return True

    def update(
        self, sample: HeldSample, reorder_rows: int, *, may_pause: bool = False
    ) -> tuple[list[HeldSample], list[HeldSample]]:
        """Update with a sample; returns accepted samples and rejected samples.

        Args:
            sample: the sample.
            reorder_rows: see `MonitorConfig`.
            may_pause: True if the next number follows after any time, as of a signal that is sent when it moves.
        """
        held, window = self.held, REMEMBERED * reorder_rows
        is_next = sample.number == self.expected and sample.time_ns > self.newest_ns
        follows = (may_pause and is_next) or self._follows(sample, window)
        if not held:
            if follows:
                self._accept(sample)
                return [sample], []
            self.held = [sample]
            return [], []
        self.held = []
        if follows:
            between = [item for item in held if self._is_between(item, sample)]
            for item in (*between, sample):
                self._accept(item)
            return [*between, sample], [item for item in held if item not in between]
        held.append(sample)
        if self._is_after_pause(held):
            for item in held:
                self._accept(item)
            return held, []
        if not self._is_run(held, window):
            self.held = [sample]
            return [], held[:-1]
        confirmed = COUNTED if self._are_next(held) else max(COUNTED, min(CONFIRMED, reorder_rows))
        if len(held) < confirmed:
            self.held = held
            return [], []
        self.expected, self.spacing = None, Spacing()
        for item in held:
            self._accept(item)
        return held, []

    def release(self) -> list[HeldSample]:
        """Release held samples at the end of a record: nothing contradicts them."""
        held, self.held = self.held, []
        return held

    def _is_after_pause(self, held: list[HeldSample]) -> bool:
        """True if samples have the next numbers at increasing times: the plant has paused."""
        times_ns = [self.newest_ns, *(item.time_ns for item in held)]
        return self._are_next(held) and all(before < after for before, after in pairwise(times_ns))

    def _are_next(self, held: list[HeldSample]) -> bool:
        """True if samples have the next numbers."""
        first = self.expected
        return first is not None and all(item.number == number for number, item in enumerate(held, start=first))

    def _is_run(self, held: list[HeldSample], window: int) -> bool:
        """True if samples follow each other as evenly as the run."""
        pairs = [(item.number - last.number, item.time_ns - last.time_ns) for last, item in pairwise(held)]
        if any(abs(numbers) > window or numbers * time_ns <= 0 for numbers, time_ns in pairs):
            return False
        if self.spacing.count < MEMORY:
            return True
        unlike = TOLERANCE + DEVIATIONS * self.spacing.deviation_ns / self.spacing.mean_ns
        spacings = [time_ns / numbers for numbers, time_ns in pairs]
        return max(spacings) - min(spacings) <= unlike * max(spacings)

    def _is_between(self, item: HeldSample, sample: HeldSample) -> bool:
        """True if number and time of an item are between the newest of the run and a sample."""
        newest = item.number if self.newest is None else self.newest
        return newest < item.number < sample.number and self.newest_ns < item.time_ns < sample.time_ns

    def _accept(self, sample: HeldSample) -> None:
        newest = self.newest
        if newest is not None:
            if sample.number <= newest:
                return
            spacing_ns = (sample.time_ns - self.newest_ns) / (sample.number - newest)
            if spacing_ns > 0.0:
                self.spacing.learn(spacing_ns, MEMORY)
        self.advance(sample.number, sample.time_ns)

    def _follows(self, sample: HeldSample, window: int) -> bool:
        """True if a sample follows the newest of the run."""
        if self.newest is None:
            return True
        numbers, time_ns = sample.number - self.newest, sample.time_ns - self.newest_ns
        if not numbers:
            return not time_ns
        if numbers < -window or time_ns * numbers <= 0:
            return False
        spacing_ns, usual = time_ns / numbers, self.spacing
        if usual.count < MEMORY:
            return not usual.count or spacing_ns <= 4.0 * usual.mean_ns
        return is_alike(usual, spacing_ns)
