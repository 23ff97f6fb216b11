"""An e-detector: a run length without a fault that no noise of known mean and variance can break.

Shin, Ramdas & Rinaldo (2024), E-detectors: a nonparametric framework for sequential change detection, New England J.
Statistics in Data Science 2(2). The limits of other charts are for normal values; here nothing of their distribution is
used but two moments. With y = (x - mean) / sigma, the class of values without a fault:

    given the values before, y has a mean in [-k, k] and a variance of at most v,

with the allowance k. So y may be skewed and heavy-tailed, change its distribution from row to row, and depend on the
past in all but these two. For a bet t > 0 on high values

    e_t(y) = 1/10 + 9/10 (1 + t (y - k))_+^2 / (1 + t^2 v)

has, given the values before, an expectation of at most 1: it increases with y, so the mean k is the worst, and there
the square without its positive part has the expectation 1 + t^2 v. (Markov's inequality for it, t chosen for the limit,
is Cantelli's, which no inequality for a mean and a variance improves.) Low values: the same of -y.

The sums of Shiryaev (1963) and Roberts (1966), one a bet and side, and their mean, which is out beyond A:

    R_t <- (1 + R_t) e_t(y),      M = mean of R_t,      out: M > A.

E[M | before] is at most 1 more than the last M, so M less the number of rows is a supermartingale; at the first point
that is out M is above A, and hence that takes at least A rows on average. CUSUM-type sums, max(1, R_t) e_t(y), have the
same bound; they are never above R_t, so they never signal before it.

The tenth that is not bet keeps a sum from 0 after one value beyond -1/t; for normal values and any shift of 0.5 to 10
it costs at most 4 % of the growth of log M at the best bet. A shift d of normal values is seen after about log(12 A)
over that growth: 0.26 a row at d = 1 and 1.08 at d = 2 (k = 0.25, v = 1.1), where a likelihood ratio with the same
allowance has 0.28 and 1.53. A single value y gives at most log(1 + (y - k)^2 / v), the price of the class for large
shifts.
"""

from math import sqrt
from typing import Self

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.charts.base import Baseline, Judgement, Setting, Shown, finite
from reactorwatch.spc.compiled_chart import PRESENT, SETTINGS, CompiledChart, X, write_point
from reactorwatch.spc.false_alarm_budget import TrainingErrors

BETS = 6
"""Bets of a side, 1/8, 1/4, ... 4: for normal values and shifts of 0.5 to 10 sigma the best of them grows at most 1.2 %
slower than the best of all."""

CEILING = 2.0
"""Times what is out by itself: a sum stops there, so that after a large change it is soon back. Run lengths are
untouched."""

_MEAN, _SIGMA, _ALLOWANCE, _VARIANCE, _LIMIT, _START = range(SETTINGS, SETTINGS + 6)
_HIGH, _LOW = _START + 2 * BETS, _START + 3 * BETS  # the sums; all of them are 0 at the start
_END = _LOW + BETS


@jit
def _judge(columns: Array) -> None:
    for p in range(columns.shape[1]):
        present = columns[PRESENT, p] > 0.0
        allowance, variance, limit = columns[_ALLOWANCE, p], columns[_VARIANCE, p], columns[_LIMIT, p]
        y = (columns[X, p] - columns[_MEAN, p]) / columns[_SIGMA, p]
        ceiling = CEILING * 2 * BETS * limit
        high = low = 0.0
        for i in range(BETS):
            bet = 0.125 * 2.0**i
            scale = 0.9 / (1.0 + bet * bet * variance)
            above, below = max(1.0 + bet * (y - allowance), 0.0), max(1.0 - bet * (y + allowance), 0.0)
            up = min((1.0 + columns[_HIGH + i, p]) * (0.1 + scale * above * above), ceiling)
            down = min((1.0 + columns[_LOW + i, p]) * (0.1 + scale * below * below), ceiling)
            columns[_HIGH + i, p] = up if present else columns[_HIGH + i, p]
            columns[_LOW + i, p] = down if present else columns[_LOW + i, p]
            high += up
            low += down
        mean = (high + low) / (2 * BETS)
        height, line = np.log1p(mean), np.log1p(limit)
        statistic = height if high >= low else -height
        write_point(columns, p, statistic, 0.0, -line, line, 1.0 if height > line else 0.0)


class EDetector(CompiledChart):
    """The evidence for a mean beyond an allowance; at least `arl0` samples to a false alarm, whatever the distribution.

    The statistic is log(1 + M), negative if the low side has more of M.

    >>> chart = EDetector(mean=0.0, sigma=1.0, arl0=100.0)
    >>> [chart.update(x).out for x in (4.0, 4.0, 4.0)]
    [False, False, True]

    Args:
        mean: mean of the values when all is well.
        sigma: standard deviation of the values when all is well.
        arl0: samples to a false alarm, at least, on average.
        allowance: k, the largest deviation of the mean that is none, in sigma.
        variance: v, the largest variance when all is well, in sigma^2.

    Raises:
        InputError: sigma, arl0 or variance is not a positive number, or allowance is negative.
    """

    name = "edetector"
    settings = (Setting("edetector_allowance", 0.25, 0.0, 5.0),)
    memories = 2 * BETS
    numbers = _END - SETTINGS
    kernel = staticmethod(_judge)

    def __init__(
        self, mean: float, sigma: float, arl0: float = 1000.0, allowance: float = 0.25, variance: float = 1.0
    ) -> None:
        positive("sigma", sigma)
        positive("arl0", arl0)
        positive("variance", variance)
        if not allowance >= 0.0:
            raise InputError(f"allowance must be 0 or more, got {allowance}")
        super().__init__([finite(mean), sigma, finite(allowance), variance, arl0], [0.0] * self.memories)

    @classmethod
    def design(cls, baseline: Baseline) -> Self:
        """See `SignalChart`; `edetector_allowance` is k.

        Mean and standard deviation are learned: the class is widened by two standard errors of each.
        """
        (learned,), (sd,) = baseline.learned, baseline.memory_sd
        allowance = max(baseline.settings["edetector_allowance"], 2.0 / sqrt(learned.rows))
        return cls(0.0, sd, baseline.arl0, allowance, (1.0 + 2.0 * sqrt(learned.sd_variance)) ** 2)

    @classmethod
    def relative_rates(cls, baseline: Baseline, errors: TrainingErrors) -> Array:
        """See `SignalChart`; the intended rate, which errors within the widened class do not raise."""
        return np.ones(len(errors.mean))

    @classmethod
    def explain(cls, judgement: Judgement, signal: Shown) -> tuple[str, dict[str, float]]:
        """See `SignalChart`."""
        text = f"{signal.name} has been {judgement.side} what the model expects, by more than any noise explains"
        return text, {signal.name: 1.0}
