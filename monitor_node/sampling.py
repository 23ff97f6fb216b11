"""Does this row follow its predecessor by one sampling period? A linear model of lagged samples holds only then."""

from dataclasses import dataclass, field
from statistics import median

LEARN_FROM = 32  # spacings
TOLERANCE = 0.1  # of the period


@dataclass
class SamplingState:
    """What is remembered: the last row's time, the spacings seen while the period is being learned, the period."""

    last_ns: int | None = None
    spacings_ns: list[int] = field(default_factory=list)
    period_ns: float | None = None


class SamplingPeriod:
    """Learns the period from the first rows, and tells which rows follow regularly.

    While the period is not known yet, a row follows if it comes no later than half again the shortest spacing so far.
    """

    def __init__(self) -> None:
        self.state = SamplingState()

    def follows(self, time_ns: int) -> bool:
        """Whether the row at this time follows the one before it by one period."""
        state = self.state
        last, state.last_ns = state.last_ns, time_ns
        if last is None:
            return False
        spacing = time_ns - last
        if spacing <= 0:
            return False
        if state.period_ns is None:
            state.spacings_ns.append(spacing)
            if len(state.spacings_ns) == LEARN_FROM:
                state.period_ns = float(median(state.spacings_ns))
            return spacing <= 1.5 * min(state.spacings_ns)
        return abs(spacing - state.period_ns) <= TOLERANCE * state.period_ns
