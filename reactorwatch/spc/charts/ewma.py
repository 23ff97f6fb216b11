"""The exponentially weighted moving average: sees small changes soon, and shows where the mean is now.

Roberts (1959), Control chart tests based on geometric moving averages, Technometrics 1(3); Lucas & Saccucci (1990),
Exponentially weighted moving average control schemes, Technometrics 32(1). With lambda the weight of the newest value

    z <- (1 - lambda) z + lambda x,      out: |z - mean| > L sigma sqrt(lambda / (2 - lambda)).

Starting at the mean, the variance of the t-th z is smaller than in the long run by the factor 1 - (1 - lambda)^(2t).
With `exact_limits` the limits follow it and so are tight at the start; otherwise they are those of the long run from
the first value on.
"""

from math import sqrt
from typing import Self

import numpy as np

from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import positive
from reactorwatch.spc import false_alarm_budget
from reactorwatch.spc.baseline import Baseline
from reactorwatch.spc.charts.base import Array, Judgement, Setting, Shown, finite
from reactorwatch.spc.compiled_chart import PRESENT, SETTINGS, CompiledChart, X, write_point
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.run_length.control_limits import ewma_limit
from reactorwatch.spc.run_length.ewma import check_parameters
from reactorwatch.spc.training_errors import TrainingErrors, relative_rate

_MEMORIES = 2
_MEAN, _WEIGHT, _LIMIT, _START = range(SETTINGS, SETTINGS + 4)
# The memory: the average, and (1 - lambda)^(2t), which is 0 from the start for fixed limits.
_AVERAGE, _MISSING, _END = range(_START + _MEMORIES, _START + _MEMORIES + 3)


@jit
def _judge(columns: Array) -> None:
    for p in range(columns.shape[1]):
        present = columns[PRESENT, p] > 0.0
        mean, weight = columns[_MEAN, p], columns[_WEIGHT, p]
        rest = 1.0 - weight
        average = rest * columns[_AVERAGE, p] + weight * columns[X, p]
        missing = rest * rest * columns[_MISSING, p]
        limit = columns[_LIMIT, p] * np.sqrt(1.0 - missing)
        columns[_AVERAGE, p] = average if present else columns[_AVERAGE, p]
        columns[_MISSING, p] = missing if present else columns[_MISSING, p]
        out = 1.0 if abs(average - mean) > limit else 0.0
        write_point(columns, p, average, mean, mean - limit, mean + limit, out)


class Ewma(CompiledChart):
    """The exponentially weighted moving average against mean +- L of its own standard deviations.

    >>> chart = Ewma(mean=0.0, sigma=1.0, weight=0.5, limit=2.0)
    >>> [chart.update(x).out for x in (2.0, 2.0)]
    [False, True]

    Args:
        mean: mean of the values when all is well.
        sigma: standard deviation of the values when all is well.
        weight: lambda, of the newest value, in (0, 1]; small for small changes.
        limit: L, in standard deviations of the average in the long run.
        exact_limits: whether the limits grow with the average's standard deviation from the start.

    Raises:
        InputError: sigma or limit is not a positive number, or weight not in (0, 1].
    """

    name = "ewma"
    settings = (Setting("ewma_weight", 0.1, 1e-3, 1.0),)
    memories = _MEMORIES
    numbers = _END - SETTINGS
    kernel = staticmethod(_judge)

    def __init__(
        self, mean: float, sigma: float, weight: float = 0.2, limit: float = 3.0, *, exact_limits: bool = False
    ) -> None:
        positive("sigma", sigma)
        check_parameters(weight, limit)
        half_width = limit * sigma * sqrt(weight / (2.0 - weight))
        super().__init__([finite(mean), weight, half_width], [mean, 1.0 if exact_limits else 0.0])

    @classmethod
    def design(cls, baseline: Baseline) -> Self:
        """See `SignalChart`; `ewma_weight` is the weight of the newest row."""
        (learned,), (sd,), weight = baseline.learned, baseline.memory_sd, baseline.settings["ewma_weight"]
        return cls(0.0, sd, weight, designed_limit(baseline.arl0, weight, learned))

    @classmethod
    def relative_rates(cls, baseline: Baseline, errors: TrainingErrors) -> Array:
        """See `SignalChart`."""
        (learned,), weight = baseline.learned, baseline.settings["ewma_weight"]
        return relative_rate(ewma_limit(baseline.arl0, weight), weight, learned, errors)

    @classmethod
    def detector(cls, baseline: Baseline) -> tuple[float, float, Array] | None:
        """See `Chart`."""
        (learned,), (sd,), weight = baseline.learned, baseline.memory_sd, baseline.settings["ewma_weight"]
        return weight, sd * designed_limit(baseline.arl0, weight, learned), np.eye(1)

    @classmethod
    def explain(cls, judgement: Judgement, signal: Shown) -> tuple[str, dict[str, float]]:
        """See `SignalChart`: as the lasting shift of the signal that would look like this."""
        size = abs(judgement.statistic) * signal.scale / signal.passed
        return signal.describe(judgement, size, lead="on average "), {signal.name: 1.0}


def designed_limit(arl0: float, weight: float, learned: Prewhitening) -> float:
    """The width L of an EWMA of weight lambda.

    Args:
        arl0: run length of the chart without a fault.
        weight: lambda.
        learned: the training.
    """
    return false_alarm_budget.widen_limit(ewma_limit(arl0, weight), weight, learned)
