"""The exponentially weighted moving average: sees small changes soon, and shows where the mean is now.

Roberts (1959), Control chart tests based on geometric moving averages, Technometrics 1(3); Lucas & Saccucci (1990),
Exponentially weighted moving average control schemes, Technometrics 32(1). With lambda the weight of the newest value

    z <- (1 - lambda) z + lambda x,      out: |z - mean| > L sigma sqrt(lambda / (2 - lambda)).

Starting at the mean, the variance of the t-th z is smaller than in the long run by the factor 1 - (1 - lambda)^(2t).
With `exact_limits` the limits follow it and so are tight at the start; otherwise they are those of the long run from
the first value on.

The run length is by its integral equation (Crowder 1987, A simple method for studying run-length distributions of EWMA
charts, Technometrics 29(4)). In units of sigma from the mean, with the limit H = L sqrt(lambda / (2 - lambda)) and the
average at u

    L(u) = 1 + 1/lambda integral from -H to H of L(y) phi((y - (1 - lambda) u) / lambda - shift) dy.

With exact limits H depends on the number of samples t; L_t follows from L_(t+1) by the same integral, backwards from
the converged limit.
"""

from functools import cache
from math import ceil, log, sqrt
from typing import Self

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.charts.base import Baseline, Design, Judgement, Setting, Shown, finite
from reactorwatch.spc.compiled_chart import PRESENT, SETTINGS, CompiledChart, X, write_point
from reactorwatch.spc.false_alarm_budget import TrainingErrors, relative_rate, widen_limit
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.run_length import (
    check_length,
    check_range,
    fastest_parameter,
    limit_for,
    nodes,
    run_lengths,
    shift_size,
    stationary_distribution,
)

_MEAN, _WEIGHT, _LIMIT, _START = range(SETTINGS, SETTINGS + 4)
# The memory: the average, and (1 - lambda)^(2t), which is 0 from the start for fixed limits.
_AVERAGE, _MISSING, _END = range(_START + 2, _START + 2 + 3)


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
    memories = 2
    numbers = _END - SETTINGS
    kernel = staticmethod(_judge)

    def __init__(
        self, mean: float, sigma: float, weight: float = 0.2, limit: float = 3.0, *, exact_limits: bool = False
    ) -> None:
        positive("sigma", sigma)
        _check(weight, limit)
        half_width = limit * sigma * sqrt(weight / (2.0 - weight))
        super().__init__([finite(mean), weight, half_width], [mean, 1.0 if exact_limits else 0.0])

    @classmethod
    def fastest(cls, arl0: float, shift: float, dimension: int, rules: tuple[int, ...]) -> Design:
        """See `Chart`."""
        weight = fastest_parameter(lambda w: ewma_run_length(shift, w, ewma_limit(arl0, w)), 0.002, 1.0)
        limit = ewma_limit(arl0, weight)
        return Design(cls.name, {"lambda": weight, "limit": limit}, arl0, shift, ewma_run_length(shift, weight, limit))

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
    return widen_limit(ewma_limit(arl0, weight), weight, learned)


@cache
def ewma_limit(arl0: float, weight: float) -> float:
    """Limit L of the EWMA of weight lambda for an in-control run length."""
    return limit_for(arl0, lambda limit: ewma_run_length(0.0, weight, limit), 0.5, 10.0)


def ewma_run_length(
    shift: float,
    weight: float = 0.2,
    limit: float = 3.0,
    *,
    exact_limits: bool = False,
    steady_state: bool = False,
) -> float:
    """Average run length of a two-sided EWMA.

    >>> round(ewma_run_length(1.0, weight=0.25, limit=3.0), 6)
    11.154267

    Args:
        shift: shift of the mean, in sigma.
        weight: lambda, in [0.001, 1].
        limit: L, in standard deviations of the average.
        exact_limits: whether the limits grow with the average's standard deviation from the start.
        steady_state: whether the chart has long run when the shift occurs.

    Raises:
        InputError: an argument out of its range.
    """
    _check(weight, limit)
    check_range("weight (lambda)", weight, 1e-3, 1.0)
    check_range("limit", limit, 1e-3, 10.0)
    size = shift_size(shift)
    bound = limit * sqrt(weight / (2.0 - weight))
    count = 40 + ceil(6.0 * bound / weight)
    points, weights = nodes(-bound, bound, count)
    lengths = run_lengths(_kernel(points, points, size, weight) * weights)
    check_length(float(lengths[count // 2]))
    if steady_state:
        return float(stationary_distribution(_kernel(points, points, 0.0, weight) * weights) @ lengths)
    if exact_limits:
        return _with_exact_limits(size, weight, bound, count, points, lengths)
    return float(1.0 + _kernel(np.zeros(1), points, size, weight)[0] * weights @ lengths)


def _check(weight: float, limit: float) -> None:
    """Check the parameters of a chart.

    Raises:
        InputError: one is out of its range.
    """
    if not 0.0 < weight <= 1.0:
        raise InputError(f"weight (lambda) must be in (0, 1], got {weight}")
    positive("limit", limit)


def _kernel(start: Array, end: Array, shift: float, weight: float) -> Array:
    """Density of the next average at `end`, from each `start`, shape (starts, ends)."""
    off = (end[None, :] - (1.0 - weight) * start[:, None]) / weight - shift
    return np.asarray(np.exp(-0.5 * off * off) / (np.sqrt(2.0 * np.pi) * weight))


def _with_exact_limits(shift: float, weight: float, bound: float, count: int, points: Array, lengths: Array) -> float:
    """Run length with exact limits, backwards from the sample at which the limit is within 1e-9 of its final value."""
    if weight == 1.0:
        return float(lengths[0])
    unit, unit_weights = nodes(-1.0, 1.0, count)
    weights = bound * unit_weights
    for t in range(ceil(log(1e-9) / (2.0 * log(1.0 - weight))), 0, -1):
        bound_before = bound * sqrt(1.0 - (1.0 - weight) ** (2 * t))
        before = bound_before * unit
        lengths = 1.0 + (_kernel(before, points, shift, weight) * weights) @ lengths
        points, weights = before, bound_before * unit_weights
    return float(1.0 + (_kernel(np.zeros(1), points, shift, weight) * weights)[0] @ lengths)
