"""A lasting change of level within an incident: the plant moves again, to its usual state or to another one.

While an alarm is active the plant is not as in its training, but it can be compared with the rows before: the mean of
the newest rows less that of as many rows before them, for each signal. How far these differences go by chance is taken
from the training, where the same differences have the wandering of the plant in them. Their standard deviation s comes
from n rows and windows of w rows. At white noise the differences have the autocorrelation 1 - 3h / 2w at small lags h,
so

- s has 3n / 2w degrees of freedom (Bartlett 1946: n / (1 + 2 sum r_h^2), whose sum is w / 3);
- the level u s is crossed in n rows with the probability 3 n u phi(u) / w, both sides together (Pickands 1969,
  Upcrossing probabilities for stationary Gaussian processes, Trans. Amer. Math. Soc. 145).

The limit is that level, at the same tail of Student's distribution. The onset of the incident is a change, too, so
nothing is tested until all signals have settled.
"""

from math import inf, pi, sqrt
from typing import Self

import msgspec
import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.stored_state import Memory

CHANCE = 0.01
"""Probability of a change by chance in an incident as long as the training. Beside the alarm that began the incident
that is next to nothing, so the test takes no share of the promised false alarms."""


class LevelChange(Memory):
    """Test for changes of level. The object is its own state.

    >>> test = LevelChange(2, [1.0])
    >>> [test.update([value]) for value in (9.0, 0.0, 0.0, 0.0, 0.0, 5.0, 5.0)]
    [[0.0], [0.0], [0.0], [-4.5], [0.0], [2.5], [5.0]]

    Attributes:
        rows: rows of a level.
        limits: largest usual change of each signal, in its unit; infinite for one that is not tested.
        recent: values of the newest rows, the oldest first, at most twice `rows` of them.
        is_settled: True once no signal changed, after the start.
    """

    rows: int
    limits: list[float]
    recent: list[list[float]] = msgspec.field(default_factory=list)
    is_settled: bool = False

    @classmethod
    def learn(cls, values: Array, rows: int) -> Self:
        """Learn the limits from a training.

        Args:
            values: values of the signals, shape (n, signals); NaN where missing or disturbed.
            rows: rows of a level.
        """
        if len(values) < 2 * rows:
            return cls(rows, [inf] * values.shape[1])
        means = np.lib.stride_tricks.sliding_window_view(values, rows, axis=0).mean(axis=2)  # NaN where one is missing
        changes = means[rows:] - means[:-rows]
        return cls(rows, [_limit(column[np.isfinite(column)], rows, values.shape[1]) for column in changes.T])

    def restart(self) -> None:
        """Forget the rows seen, after a gap."""
        self.recent.clear()

    def start(self) -> None:
        """Wait for the next incident."""
        self.restart()
        self.is_settled = False

    def update(self, values: list[float]) -> list[float]:
        """Take a row; returns the change of each signal, 0 where it is unknown.

        Args:
            values: values of the signals; NaN where missing.
        """
        self.recent.append(values)
        del self.recent[: -2 * self.rows]
        if len(self.recent) < 2 * self.rows:
            return [0.0] * len(values)
        window = np.array(self.recent).reshape(2, self.rows, -1)
        known = np.isfinite(window)
        counts = known.sum(axis=1)
        before, after = np.where(known, window, 0.0).sum(axis=1) / np.maximum(counts, 1)
        changes: list[float] = np.where(counts.min(axis=0) > self.rows // 2, after - before, 0.0).tolist()
        return changes


def _limit(changes: Array, rows: int, signals: int) -> float:
    """Limit of the changes of a signal, from those of the training; infinite where these are too few."""
    from scipy import optimize  # takes a fifth of a second, which a monitor's start does not need

    count = (len(changes) + 2 * rows) / rows
    sd = sqrt(float(np.mean(changes**2))) if len(changes) else 0.0
    # of fewer windows than four nothing can be learned, as of fewer blocks in the screening of a training
    if count < 4.0 or sd <= 0.0:
        return inf

    def excess(u: float) -> float:
        return 3.0 * count * u * float(np.exp(-0.5 * u * u)) / sqrt(2.0 * pi) * signals - CHANCE

    level = float(optimize.brentq(excess, 1.0, 40.0))  # beyond 1 the probability falls; at 40 it is 0 in doubles
    return -float(special.stdtrit(1.5 * count, float(special.ndtr(-level)))) * sd
