"""Scores of a detector in a run, and over many runs: shares, delays, rates."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np
from scipy import stats

from benchmarks.faults.bank import PERIOD_MIN

DAYS_30_MIN = 30 * 24 * 60.0


@dataclass(frozen=True)
class Interval:
    """Interval in which an alarm was active."""

    raised_min: float  # time when it was raised
    cleared_min: float  # time when it was cleared; inf: it is still active


@dataclass(frozen=True)
class Outcome:
    """Outcome of a detector in a run with a fault."""

    delay_min: float  # delay from the onset to the detection; inf: not detected
    false_alarms: int = 0  # number of alarms raised before the onset
    watched_min: float = 0.0  # watched time before the onset


def outcome_of(alarms: Sequence[Interval], watching_since_min: float, onset_min: float, until_min: float) -> Outcome:
    """Detection and false alarms of a run.

    The detection is the first alarm that is raised after the onset while no other stands: one that was standing
    already has no news for the operator.
    """
    detected_min, standing_until_min = inf, -inf
    for item in sorted(alarms, key=lambda item: item.raised_min):
        if onset_min <= item.raised_min <= until_min and item.raised_min >= standing_until_min:
            detected_min = item.raised_min
            break
        standing_until_min = max(standing_until_min, item.cleared_min)
    return Outcome(
        delay_min=detected_min - onset_min,
        false_alarms=sum(item.raised_min < onset_min for item in alarms),
        watched_min=max(onset_min - watching_since_min, 0.0),
    )


@dataclass(frozen=True)
class Delays:
    """The delays of many runs."""

    detected: float  # share of the runs, in [0, 1]
    median_min: float  # median of all runs, those not detected counted as infinite
    slow_min: float  # 90 % quantile of all runs, those not detected counted as infinite

    @classmethod
    def of(cls, delays_min: Sequence[float]) -> "Delays":
        """Statistics of at least one delay; inf: not detected."""
        values = np.array(delays_min)
        median, slow = np.quantile(values, [0.5, 0.9], method="inverted_cdf")
        return cls(float(np.isfinite(values).mean()), float(median), float(slow))


@dataclass(frozen=True)
class Rate:
    """Rate of chance events."""

    count: int  # number of events
    watched_min: float  # watched time

    @property
    def per_30_days(self) -> float:
        """The rate."""
        return self.count / self.watched_min * DAYS_30_MIN if self.watched_min else 0.0

    @property
    def interval_per_30_days(self) -> tuple[float, float]:
        """The 95 % interval of the rate, were the events independent: Garwood (1936), Biometrika 28, 437-442."""
        if not self.watched_min:
            return 0.0, inf
        lower = float(stats.chi2.ppf(0.025, 2 * self.count)) / 2 if self.count else 0.0
        upper = float(stats.chi2.ppf(0.975, 2 * self.count + 2)) / 2
        return lower / self.watched_min * DAYS_30_MIN, upper / self.watched_min * DAYS_30_MIN

    @classmethod
    def total(cls, rates: Sequence["Rate"]) -> "Rate":
        """Rate of all together."""
        return cls(sum(item.count for item in rates), sum(item.watched_min for item in rates))


def rows_to_false_alarm(false_alarms_per_30_days: float) -> float:
    """Mean number of rows from one false alarm to the next."""
    return DAYS_30_MIN / false_alarms_per_30_days / PERIOD_MIN
