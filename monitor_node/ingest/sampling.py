"""Spacing of samples, sampling period of rows, and the interval between a row and its predecessor.

`Spacing` follows a plant that slows down, as timeouts and the check of sequence numbers need. `SamplingPeriod` is fixed
once it is learned, because the models of the training hold for one period; so it is the median of the first intervals.

A row *follows* if it is one sampling period after its predecessor, to a tenth: a linear model of lagged samples holds
only then. A *gap* is more than two and a half periods, or a step back in time: the rows before it are then too old to
tell chance from change.
"""

from dataclasses import dataclass, field, replace
from statistics import median

import msgspec

LEARN_FROM = 32  # spacings
TOLERANCE = 0.1  # of the period
LARGEST_GAP = 2.5  # periods
WHOLE = 0.25  # of a period: tolerance of an interval of several whole periods, in which rows are missing


class Spacing(msgspec.Struct, forbid_unknown_fields=True):
    """Usual spacing of samples, by exponential means; the object is its own state.

    Attributes:
        count: number of spacings in the means, up to their memory.
        mean_ns: exponential mean of the spacings.
        deviation_ns: exponential mean of their absolute deviations.
    """

    count: int = 0
    mean_ns: float = 0.0
    deviation_ns: float = 0.0

    def learn(self, spacing_ns: float, memory: int) -> None:
        """Update the means, over `memory` spacings, with a spacing."""
        self.count = min(self.count + 1, memory)
        deviation = spacing_ns - self.mean_ns
        self.mean_ns += deviation / self.count
        if self.count > 1:
            self.deviation_ns += (abs(deviation) - self.deviation_ns) / self.count


@dataclass
class SamplingState:
    """State of a sampling period.

    Attributes:
        last_ns: time of the last row; None before the first.
        spacings_ns: intervals from which the period will be learned.
        period_ns: sampling period; None before it is learned.
        spacing_ns: interval before the last row; None before the second.
    """

    last_ns: int | None = None
    spacings_ns: list[int] = field(default_factory=list)
    period_ns: float | None = None
    spacing_ns: int | None = None


class SamplingPeriod:
    """Sampling period, learned from the first rows.

    Before it is learned, a row follows within 1.5 times the shortest interval so far.
    """

    def __init__(self) -> None:
        self.state = SamplingState()

    def copy_state(self) -> SamplingState:
        """A copy of the state."""
        return replace(self.state, spacings_ns=list(self.state.spacings_ns))

    def follows(self, time_ns: int) -> bool:
        """Update with a row; returns True if it follows its predecessor by one period."""
        state = self.state
        last, state.last_ns = state.last_ns, time_ns
        if last is None:
            return False
        spacing = state.spacing_ns = time_ns - last
        if spacing == state.period_ns:  # as mostly
            return True
        if spacing <= 0:
            return False
        if state.period_ns is None:
            state.spacings_ns.append(spacing)
            if len(state.spacings_ns) == LEARN_FROM:
                state.period_ns = float(median(state.spacings_ns))
            return spacing <= 1.5 * min(state.spacings_ns)
        return abs(spacing - state.period_ns) <= TOLERANCE * state.period_ns

    @property
    def period_ns(self) -> float:
        """Sampling period; before it is learned, the shortest interval so far; 0 before the second row."""
        state = self.state
        return state.period_ns if state.period_ns is not None else float(min(state.spacings_ns, default=0))

    @property
    def missing(self) -> int:
        """Number of rows missing before the newest row, by its time."""
        spacing, period = self.state.spacing_ns, self.state.period_ns
        if spacing is None or period is None or spacing == period:
            return 0
        return missing_rows(spacing / period)

    @property
    def gap(self) -> bool:
        """True if there is a gap before the newest row."""
        spacing = self.state.spacing_ns
        if spacing is None or spacing == self.state.period_ns:
            return False
        return spacing <= 0 or spacing > LARGEST_GAP * self.period_ns


def missing_rows(periods: float) -> int:
    """Number of rows missing between two rows that are `periods` sampling periods apart.

    With irregular rows, an interval that is no whole number of periods is no evidence of a lost row.

    >>> [missing_rows(periods) for periods in (0.9, 1.4, 2.0, 2.4, 3.1)]
    [0, 0, 1, 0, 2]
    """
    whole = round(periods)
    return whole - 1 if whole > 1 and abs(periods - whole) <= WHOLE else 0
