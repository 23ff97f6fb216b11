"""Rows: their sampling period, and the interval between a row and its predecessor.

The period is fixed once it is learned, because the models of the training hold for one period; so it is the median of
the first intervals. The `Spacing` of a signal's samples (`spc.silence`) follows a plant that slows down.

A row *follows* if it is one sampling period after its predecessor, to a tenth: a linear model of lagged samples holds
only then. A *gap* is more than two and a half periods, or a step back in time: the rows before it are then too old to
tell chance from change.
"""

from dataclasses import dataclass
from statistics import median
from typing import NamedTuple

import numpy as np
from msgspec import field
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.contract.codec import Publication
from reactorwatch.stored_state import Memory

LEARN_FROM = 32  # spacings
TOLERANCE = 0.1  # of the period
LARGEST_GAP = 2.5  # periods
WHOLE = 0.25  # of a period: tolerance of an interval of several whole periods, in which rows are missing


class Row(NamedTuple):
    """Measured values of one time.

    Attributes:
        time_ns: sample time.
        values: one value a signal, in the order of the aligner's signals; NaN if missing.
        restarted: True for the first row of a new run of the publisher.
    """

    time_ns: int
    values: tuple[float, ...]
    restarted: bool


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


@dataclass(slots=True)
class MeasuredRow:
    """A row on its way through the stages of the pipeline.

    Attributes:
        time_ns: sample time.
        inputs: one value an input; NaN if missing.
        values: one value an output; NaN if missing, or if the signal checks found that it is no measurement.
        units: units of the outputs.
        interval: interval before the row.
        follows: True if the row is one sampling period after its predecessor in the same run.
        publications: publications because of the row so far.
    """

    time_ns: int
    inputs: tuple[float, ...]
    values: list[float]
    units: list[str]
    interval: Interval
    follows: bool
    publications: list[Publication]


class SamplingPeriod(Memory):
    """Sampling period, learned from the first rows; the object is its own state.

    Before it is learned, a row follows within 1.5 times the shortest interval so far.

    Attributes:
        last_ns: time of the last row; None before the first.
        spacings_ns: intervals from which the period is learned.
        learned_ns: sampling period; None before it is learned.
        spacing_ns: interval before the last row; None before the second.
    """

    last_ns: int | None = None
    spacings_ns: list[int] = field(default_factory=list)
    learned_ns: float | None = None
    spacing_ns: int | None = None

    def update(self, time_ns: int) -> Interval:
        """Update with a row; returns the interval before it."""
        last, self.last_ns = self.last_ns, time_ns
        if last is None:
            return NO_INTERVAL
        spacing = self.spacing_ns = time_ns - last
        if spacing == self.learned_ns:  # as mostly
            return ONE_PERIOD
        if spacing <= 0:
            return Interval(False, True, 0)
        if self.learned_ns is None:
            self.spacings_ns.append(spacing)
            if len(self.spacings_ns) == LEARN_FROM:
                self.learned_ns = float(median(self.spacings_ns))
            follows = spacing <= 1.5 * min(self.spacings_ns)
        else:
            follows = abs(spacing - self.learned_ns) <= TOLERANCE * self.learned_ns
        missing = 0 if self.learned_ns is None else missing_rows(spacing / self.learned_ns)
        return Interval(follows, spacing > LARGEST_GAP * self.period_ns, missing)

    @property
    def period_ns(self) -> float:
        """Sampling period; before it is learned, the shortest interval so far; 0 before the second row."""
        return self.learned_ns if self.learned_ns is not None else float(min(self.spacings_ns, default=0))


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
