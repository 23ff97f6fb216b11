"""Spacing of samples, sampling period of rows, and the interval between a row and its predecessor.

`Spacing` follows a plant that slows down, as timeouts and the check of sequence numbers need. `SamplingPeriod` is fixed
once it is learned, because the models of the training hold for one period; so it is the median of the first intervals.

A row *follows* if it is one sampling period after its predecessor, to a tenth: a linear model of lagged samples holds
only then. A *gap* is more than two and a half periods, or a step back in time: the rows before it are then too old to
tell chance from change.
"""

from dataclasses import dataclass, field, replace
from statistics import median
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit, python_function

LEARN_FROM = 32  # spacings
TOLERANCE = 0.1  # of the period
LARGEST_GAP = 2.5  # periods
WHOLE = 0.25  # of a period: tolerance of an interval of several whole periods, in which rows are missing


SPACING = np.dtype([("mean_ns", "f8"), ("deviation_ns", "f8"), ("count", "i8")], align=True)
"""Numbers of a spacing, see `Spacing`."""


@jit
def learn_spacing(s: Any, spacing_ns: float, memory: int) -> None:
    """Update exponential means, over `memory` spacings, with a spacing."""
    s.count = min(s.count + 1, memory)
    deviation = spacing_ns - s.mean_ns
    s.mean_ns += deviation / s.count
    if s.count > 1:
        s.deviation_ns += (abs(deviation) - s.deviation_ns) / s.count


_LEARN = python_function(learn_spacing)


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

    @staticmethod
    def of_numbers(numbers: np.void) -> "Spacing":
        """Spacing with given numbers, see `SPACING`."""
        return Spacing(int(numbers["count"]), float(numbers["mean_ns"]), float(numbers["deviation_ns"]))

    @property
    def numbers(self) -> tuple[float, float, int]:
        """The numbers, in the order of `SPACING`."""
        return self.mean_ns, self.deviation_ns, self.count

    def learn(self, spacing_ns: float, memory: int) -> None:
        """Update the means, over `memory` spacings, with a spacing."""
        _LEARN(self, spacing_ns, memory)


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


class Interval(NamedTuple):
    """Interval between a row and its predecessor.

    Attributes:
        follows: True if it is one sampling period.
        is_gap: True if it is a gap.
        missing: number of rows that are missing in it, by its length.
    """

    follows: bool
    is_gap: bool
    missing: int


NO_INTERVAL, ONE_PERIOD = Interval(False, False, 0), Interval(True, False, 0)


class SamplingPeriod:
    """Sampling period, learned from the first rows.

    Before it is learned, a row follows within 1.5 times the shortest interval so far.
    """

    def __init__(self) -> None:
        self.state = SamplingState()

    def copy_state(self) -> SamplingState:
        """A copy of the state."""
        return replace(self.state, spacings_ns=list(self.state.spacings_ns))

    def update(self, time_ns: int) -> Interval:
        """Update with a row; returns the interval before it."""
        state = self.state
        last, state.last_ns = state.last_ns, time_ns
        if last is None:
            return NO_INTERVAL
        spacing = state.spacing_ns = time_ns - last
        if spacing == state.period_ns:  # as mostly
            return ONE_PERIOD
        if spacing <= 0:
            return Interval(False, True, 0)
        if state.period_ns is None:
            state.spacings_ns.append(spacing)
            if len(state.spacings_ns) == LEARN_FROM:
                state.period_ns = float(median(state.spacings_ns))
            follows = spacing <= 1.5 * min(state.spacings_ns)
        else:
            follows = abs(spacing - state.period_ns) <= TOLERANCE * state.period_ns
        missing = 0 if state.period_ns is None else missing_rows(spacing / state.period_ns)
        return Interval(follows, spacing > LARGEST_GAP * self.period_ns, missing)

    @property
    def period_ns(self) -> float:
        """Sampling period; before it is learned, the shortest interval so far; 0 before the second row."""
        state = self.state
        return state.period_ns if state.period_ns is not None else float(min(state.spacings_ns, default=0))


def missing_rows(periods: float) -> int:
    """Number of rows missing between two rows that are `periods` sampling periods apart.

    With irregular rows, an interval that is no whole number of periods is no evidence of a lost row.

    >>> [missing_rows(periods) for periods in (0.9, 1.4, 2.0, 2.4, 3.1)]
    [0, 0, 1, 0, 2]
    """
    whole = round(periods)
    return whole - 1 if whole > 1 and abs(periods - whole) <= WHOLE else 0


def regular_intervals(time_min: Array) -> NDArray[np.bool_]:
    """Flags of the intervals of a record that are one sampling period, its median interval, to a tenth; shape (n - 1,).

    Args:
        time_min: times of the rows, shape (n,).
    """
    spacings = np.diff(time_min)
    period = np.median(spacings) if spacings.size else 0.0
    return np.abs(spacings - period) <= TOLERANCE * period


def missing_in_intervals(time_min: Array) -> NDArray[np.intp]:
    """Numbers of rows missing in the intervals of a record, by its median interval, shape (n - 1,).

    Args:
        time_min: times of the rows, shape (n,).

    >>> missing_in_intervals(np.array([0.0, 1.0, 2.0, 4.0, 5.0])).tolist()
    [0, 0, 1, 0]
    """
    spacings = np.diff(time_min)
    periods = spacings / (np.median(spacings) if spacings.size else 1.0)
    return np.array([missing_rows(item) for item in periods.tolist()], dtype=np.intp)
