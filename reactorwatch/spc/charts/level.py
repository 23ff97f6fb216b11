"""The level of each signal against that of the training: what moves more slowly than the noise, and lasts.

A model that follows the plant also follows a slow fall, and its residuals show nothing. This chart compares with the
training for good: it takes the exponentially weighted average of each measured value and is out as long as one of them
is farther from its mean of the training than a slowly wandering signal comes by chance.

The average of a wandering signal is itself a stationary process of standard deviation s and correlation r from row to
row. It leaves +-L s as often as neighbours lie on two sides of a limit,

    1 / ARL0 = 2 P(x <= L s, x' > L s) = 4 T(L, sqrt((1 - r) / (1 + r))),

T being Owen's (1956, Tables for computing bivariate normal probabilities, Ann. Math. Statist. 27); for r near 1 it is
the formula of Rice (1944, Mathematical analysis of random noise, Bell System Techn. J. 23). s and r are learned from
the averages of the training. A training of n rows has n / (1 + 2 sum r_k) independent values for the mean, and n / (1 +
2 sum r_k^2) for the variance (Bartlett 1946), with the correlations up to where they first vanish (initial positive
sequence: Geyer 1992, Practical Markov chain Monte Carlo, Statist. Sci. 7), each raised for the mean that was
subtracted. By both the limit is widened to Student's prediction interval: a training that is short against what the
signal remembers says little, and the limit is wide.

Where signals are several, the ratios of s^2 to the mean square of the average's steps, which is well known, moderate
each other (`residual_space.moderate`).
"""

from collections.abc import Sequence
from math import sqrt
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.charts.base import Judgement, Setting, vector
from reactorwatch.spc.charts.residual_space import moderate
from reactorwatch.spc.charts.value_chart import ValueBaseline, ValueChart, average_rows
from reactorwatch.spc.false_alarm_budget import TrainingErrors, student_tail
from reactorwatch.spc.run_length import limit_for
from reactorwatch.stored_state import Memory


class LevelMemory(Memory):
    """Memory of the chart.

    Attributes:
        names: names of the signals.
        weight: lambda.
        limit: limit of the averages.
        centres: mean of each signal in the training.
        scales: one unit of the limit, in the units of each signal.
        averages: deviation of each average from its mean.
    """

    names: tuple[str, ...]
    weight: float
    limit: float
    centres: Array
    scales: Array
    averages: Array


class Level(ValueChart):
    """The average of each signal against its mean and slow variation in the training.

    >>> chart = Level(["T"], [80.0], [2.0], weight=0.5, limit=4.0)
    >>> [chart.update([x]).out for x in (76.0, 66.0, 66.0, 66.0)]
    [False, False, True, True]

    Args:
        names: names of the signals.
        centres: mean of each signal, shape (p,).
        scales: standard deviation of each average, shape (p,).
        weight: lambda, of the newest row, in (0, 1].
        limit: limit of the averages, in these standard deviations.

    Raises:
        InputError: an argument is out of its range, or the shapes differ.
    """

    name = "level"
    memory_type = LevelMemory
    fewest_signals = 1
    settings = (Setting("level_weight", 0.1, 0.001, 1.0),)

    def __init__(
        self, names: Sequence[str], centres: ArrayLike, scales: ArrayLike, weight: float, limit: float
    ) -> None:
        if not 0.0 < weight <= 1.0:
            raise InputError(f"weight (lambda) must be in (0, 1], got {weight}")
        middle, sds = np.array(centres, np.float64), np.array(scales, np.float64)
        if not middle.shape == sds.shape == (len(names),) or not np.all(np.isfinite(middle)) or not np.all(sds > 0.0):
            raise InputError(f"centres and scales must be {len(names)} finite numbers, scales positive, got {sds}")
        memory = LevelMemory(tuple(names), weight, positive("limit", limit), middle, sds, np.zeros(len(names)))
        self._use(memory)

    def _use(self, memory: LevelMemory) -> None:
        """See `Chart`."""
        self.memory, self.names = memory, memory.names
        for numbers in (memory.centres, memory.scales, memory.averages):
            vector(numbers, len(self.names))

    @classmethod
    def design(cls, baseline: ValueBaseline) -> Self:
        """See `ValueChart`; `level_weight` is the weight of the newest row."""
        weight = baseline.settings["level_weight"]
        slow = SlowProcess.of(baseline.values, weight)
        allowed, largest = slow.limits(baseline.arl0), float(np.max(slow.known_limits(baseline.arl0)))
        return cls(baseline.names, slow.means, slow.sds * allowed / largest, weight, largest)

    @classmethod
    def relative_rates(cls, baseline: ValueBaseline) -> Array:
        """See `ValueChart`: an average whose variance is off crosses the limit more or less often."""
        slow = SlowProcess.of(baseline.values, baseline.settings["level_weight"])
        known, errors = slow.known_limits(baseline.arl0), TrainingErrors.draw(len(baseline.names)).scale
        limits = -special.stdtrit(slow.freedom, special.ndtr(-known))
        tails = [student_tail(limit, slow.freedom, errors[:, i]) for i, limit in enumerate(limits.tolist())]
        return np.asarray(np.sum([tail / special.ndtr(-L) for tail, L in zip(tails, known, strict=True)], axis=0))

    def update(self, x: ArrayLike) -> Judgement:
        """See `Chart`; x has shape (p,), NaN where a value is missing, whose average stays as it is."""
        memory, values = self.memory, np.asarray(x, np.float64)
        known = np.isfinite(values)
        vector(np.where(np.isnan(values), 0.0, values), len(self.names))
        off = np.where(known, values - memory.centres, memory.averages)
        memory.averages += memory.weight * (off - memory.averages)
        statistic = float(np.max(np.abs(memory.averages) / memory.scales))
        return Judgement(statistic, 0.0, 0.0, memory.limit, statistic > memory.limit)

    def fill(self, x: Array) -> Array | None:
        """See `ValueChart`: a missing value stays missing."""
        return x if np.isfinite(x).any() else None

    def explain(self) -> tuple[str, dict[str, float]]:
        """See `ValueChart`: the signals outside their training, and shares of the squared deviations."""
        memory = self.memory
        sizes = memory.averages / memory.scales
        order = np.argsort(-np.abs(sizes), kind="stable").tolist()
        outside = [i for i in order if abs(sizes[i]) > memory.limit] or order[:1]
        named = [
            f"{self.names[i]} is on average {memory.centres[i] + memory.averages[i]:.4g} "
            f"(allowed: {memory.centres[i] - memory.limit * memory.scales[i]:.4g} to "
            f"{memory.centres[i] + memory.limit * memory.scales[i]:.4g})"
            for i in outside[:3]
        ]
        shares = sizes**2 / np.sum(sizes**2)
        return f"outside its training: {' and '.join(named)}", {self.names[i]: float(shares[i]) for i in order}

    def restart(self) -> None:
        """Forget the rows seen."""
        self.memory.averages[:] = 0.0


class SlowProcess(NamedTuple):
    """Averages of the signals in a training, as stationary processes.

    Attributes:
        means: mean of each signal.
        sds: standard deviation of each average.
        steps: ratio of the mean square of its steps to its variance, 2 (1 - r).
        independent: number of independent values by which each mean is known.
        freedom: degrees of freedom of the variances.
    """

    means: Array
    sds: Array
    steps: Array
    independent: Array
    freedom: float

    @classmethod
    def of(cls, values: Array, weight: float) -> Self:
        """Learn them from a training, shape (rows, signals)."""
        means = values.mean(axis=0)
        averages = average_rows(values - means, weight)
        squares, steps = averages.var(axis=0), np.mean(np.diff(averages, axis=0) ** 2, axis=0)
        counts = np.array([independent_values(column) for column in averages.T])
        independent, freedom = counts[:, 0], float(np.mean(counts[:, 1]))
        # less the variance of the mean that was subtracted; of fewer than two independent values nothing is known
        ratios = squares / (1.0 - 1.0 / np.maximum(independent, 2.0)) / steps
        if ratios.size > 1:
            ratios, freedom = moderate(ratios, freedom)
        return cls(means, np.sqrt(ratios * steps), np.minimum(1.0 / ratios, 2.0), independent, freedom)

    def known_limits(self, arl0: float) -> Array:
        """Limit of each average whose variance is known, in standard deviations."""
        return np.array([level_limit(arl0, step) for step in self.steps.tolist()])

    def limits(self, arl0: float) -> Array:
        """The same with the errors of the training."""
        student = -special.stdtrit(self.freedom, special.ndtr(-self.known_limits(arl0)))
        return np.asarray(student * np.sqrt(1.0 + 1.0 / self.independent))


def level_run_length(limit: float, step: float) -> float:
    """Mean number of rows between two crossings of +- a limit by a stationary normal process.

    Args:
        limit: limit in standard deviations.
        step: mean square of the steps from row to row over the variance, in (0, 2]; 2 (1 - r).
    """
    crossing = 4.0 * float(special.owens_t(limit, sqrt(step / (4.0 - step))))
    return 1.0 / max(crossing, 1e-300)


def level_limit(arl0: float, step: float) -> float:
    """Limit of such a process for a run length without a fault; at least half a standard deviation."""
    if level_run_length(0.5, step) > arl0:  # it hardly moves, and leaves no limit so often
        return 0.5
    return limit_for(arl0, lambda limit: level_run_length(limit, step), 0.5, 10.0)


def independent_values(average: Array) -> tuple[float, float]:
    """Number of independent values by which the mean and the variance of a correlated signal are known.

    Args:
        average: shape (rows,).
    """
    rows = average.size
    spectrum = np.fft.rfft(average - average.mean(), 2 * rows)
    products = np.fft.irfft(np.abs(spectrum) ** 2)[: rows // 2]
    correlations = products / products[0]
    pairs = correlations[: correlations.size // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0.05)  # below that they are hardly told from 0, and their sum would wander
    correlations = correlations[: 2 * int(ends[0]) if ends.size else pairs.size * 2]
    share = max(2.0 * float(correlations.sum()) - 1.0, 1.0) / rows
    correlations = correlations + share * (1.0 - correlations)
    of_mean = max(2.0 * float(correlations.sum()) - 1.0, 1.0)
    of_variance = max(2.0 * float(np.sum(correlations**2)) - 1.0, 1.0)
    return rows / of_mean, max(rows / of_variance, 3.0)  # Student's with fewer has no variance
