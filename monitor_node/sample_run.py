"""Which samples of a signal are of the plant that is being watched, told by their numbers and times alone.

A plant counts the samples of each signal, and its clock goes on as it counts. So a sample *follows* another if the time
between them is between an eighth and four times the usual spacing for each number between them; a late one follows
backwards, as far as rows are remembered. A sample that does not follow is of another plant of the same name, or of
somebody who plays with the bus, or damaged; or the plant was started anew, its clock was set, or it paused. One sample
does not tell which, but the next ones do:

- It is held back. As soon as one comes that follows the run as it was, the held ones are refused.
- Three that follow each other, without any of the run between them, are the run from now on, and none of them is lost.
- If the next one follows both, nothing was wrong but the time between two samples, and none is lost.

So a pause costs a delay of two samples and nothing else, and of two plants with one name the first is watched on as
long as it lives. What is decided depends on the samples alone, so a replay decides the same.
"""

from dataclasses import dataclass, field
from typing import NamedTuple

CONFIRMED = 3
"""Samples that follow each other are a run."""

SOONEST, LATEST = 0.125, 4.0
"""Of the usual spacing."""

MEMORY = 8
"""Spacings over which the usual one is forgotten."""

ALIKE = 0.01
"""Spacings that differ by less teach nothing."""


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
        held: samples that wait for the next ones.
    """

    number: int | None = None
    time_ns: int = 0
    spacing_ns: float = 0.0
    held: list[Held] = field(default_factory=list)

    def goes_on(self, time_ns: int, number: int) -> bool:
        """Take in the sample that comes next, if it is that, and comes when it usually does; whether it was taken."""
        if self.held or number - 1 != self.number:
            return False
        if abs(time_ns - self.time_ns - self.spacing_ns) > ALIKE * self.spacing_ns:
            return False
        self.number, self.time_ns = number, time_ns
        return True

    def take(self, sample: Held, window: int) -> tuple[list[Held], list[Held]]:
        """Take a sample in; returns those that are of the run, and those that are refused.

        Args:
            sample: that came.
            window: how far a number may fall back.
        """
        held = self.held
        follows = self.number is None or _follows(
            sample.number - self.number, sample.time_ns - self.time_ns, self.spacing_ns, window
        )
        if not held:
            if follows:
                self._go_on(sample)
                return [sample], []
            self.held = [sample]
            return [], []
        last = held[-1]
        goes_with = 0 < abs(sample.number - last.number) <= window and _follows(
            sample.number - last.number, sample.time_ns - last.time_ns, 0.0, window
        )
        if follows and not (goes_with and self._is_ahead(held)):
            self.held = []
            self._go_on(sample)
            return [sample], held
        if not goes_with:
            self.held = [sample]
            return [], held
        held.append(sample)
        if not follows and len(held) < CONFIRMED:
            return [], []
        self.held = []
        if not follows:
            self.number, self.spacing_ns = None, 0.0
        for item in held:
            self._go_on(item)
        return held, []

    def released(self) -> list[Held]:
        """The held ones, at the end of a record: nothing contradicts them."""
        held, self.held = self.held, []
        return held

    def _is_ahead(self, held: list[Held]) -> bool:
        """Whether samples may be of the run for all that their numbers and the order of their times say."""
        return self.number is not None and all(
            item.number > self.number and item.time_ns > self.time_ns for item in held
        )

    def _go_on(self, sample: Held) -> None:
        if self.number is None or sample.number > self.number:
            if self.number is not None:
                self._learn((sample.time_ns - self.time_ns) / (sample.number - self.number))
            self.number, self.time_ns = sample.number, sample.time_ns

    def _learn(self, spacing_ns: float) -> None:
        if spacing_ns <= 0.0 or abs(spacing_ns - self.spacing_ns) <= ALIKE * self.spacing_ns:
            return
        self.spacing_ns += (spacing_ns - self.spacing_ns) / (MEMORY if self.spacing_ns else 1)


def _follows(numbers: int, time_ns: int, spacing_ns: float, window: int) -> bool:
    """Whether a sample follows another.

    Args:
        numbers: from the other to it.
        time_ns: likewise.
        spacing_ns: as usual; 0: not known.
        window: how far a number may fall back.
    """
    if numbers == 0:
        return time_ns == 0
    if numbers < -window or time_ns == 0 or (time_ns > 0) != (numbers > 0):
        return False
    return not spacing_ns or SOONEST * spacing_ns <= time_ns / numbers <= LATEST * spacing_ns
