"""How often rows come, and what is between this one and the one before.

A row *follows* if it is one sampling period after its predecessor, to a tenth: a linear model of lagged samples holds
only then. A *gap* is more than two and a half periods, or a step back in time: what was known of the rows just
before is then too old to tell chance from change.
"""

from dataclasses import dataclass, field, replace
from statistics import median

LEARN_FROM = 32  # spacings
TOLERANCE = 0.1  # of the period
LARGEST_GAP = 2.5  # periods
WHOLE = 0.25  # of a period: rows that are so near to some whole periods apart have rows missing between them


@dataclass
class SamplingState:
    """What is remembered.

    Attributes:
        last_ns: time of the last row; None before the first.
        spacings_ns: seen while the period is being learned.
        period_ns: learned; None before.
        spacing_ns: between the last row and the one before it; None before the second.
    """

    last_ns: int | None = None
    spacings_ns: list[int] = field(default_factory=list)
    period_ns: float | None = None
    spacing_ns: int | None = None


class SamplingPeriod:
    """Learns the period from the first rows, and tells how each row comes after the one before.

    While the period is not known yet, a row follows if it comes no later than half again the shortest spacing so far.
    """

    def __init__(self) -> None:
        self.state = SamplingState()

    def copied(self) -> SamplingState:
        """A copy of all that is remembered."""
        return replace(self.state, spacings_ns=list(self.state.spacings_ns))

    def follows(self, time_ns: int) -> bool:
        """Take a row in; whether it follows the one before it by one period."""
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
        """The sampling period; before it is known, the shortest spacing so far; 0 before the second row."""
        state = self.state
        return state.period_ns if state.period_ns is not None else float(min(state.spacings_ns, default=0))

    @property
    def missing(self) -> int:
        """Number of rows missing between the newest row and the one before it, by their times."""
        spacing, period = self.state.spacing_ns, self.state.period_ns
        if spacing is None or period is None or spacing == period:
            return 0
        return missing_rows(spacing / period)

    @property
    def gap(self) -> bool:
        """Whether there is a gap before the row that was taken in last."""
        spacing = self.state.spacing_ns
        if spacing is None or spacing == self.state.period_ns:
            return False
        return spacing <= 0 or spacing > LARGEST_GAP * self.period_ns


def missing_rows(periods: float) -> int:
    """Number of rows missing between two rows that are so many usual periods apart.

    Where rows come irregularly, an interval that is no whole number of periods says nothing of a row that was lost.

    >>> [missing_rows(periods) for periods in (0.9, 1.4, 2.0, 2.4, 3.1)]
    [0, 0, 1, 0, 2]
    """
    whole = round(periods)
    return whole - 1 if whole > 1 and abs(periods - whole) <= WHOLE else 0
