"""The cumulative sum: sees a small lasting change soonest.

Page (1954), Continuous inspection schemes, Biometrika 41; two-sided and with a head start: Lucas & Crosier (1982), Fast
initial response for CUSUM quality-control schemes, Technometrics 24(3). With y = x - mean

    high <- max(0, high + y - k sigma)      low <- max(0, low - y - k sigma)      out: either above h sigma.

Each sum counts how far the values have been beyond the mean by more than the allowance k. With k half the change that
matters, no test with the same rate of false alarms finds that change faster in the worst case (Moustakides 1986). The
sums start at 0 or, for a fast first response, at `head_start`: a fault that is there at the start is then found in
half the time, and without one the sums are soon back at 0.

The statistic is the larger of the two sums, negative if it is the low one, in the units of the values.

The run length is by Page's integral equation. One side, started at u, that stays at 0 with a probability and otherwise
moves over (0, h] (Page 1954; Brook & Evans 1972 solve the same by a chain):

    L(u) = 1 + L(0) Phi(k - u - shift) + integral from 0 to h of L(y) phi(y + k - u - shift) dy.

Two sides, started at u and v (Lucas & Crosier 1982, appendix; Van Dobben de Bruyn 1968 for u = v = 0): if the low
sum is 0 whenever the high one signals, and the other way round, the side that signals first leaves the other in its
initial state, and therefore

    L(u, v) = (L+(u) L-(0) + L-(v) L+(0) - L+(0) L-(0)) / (L+(0) + L-(0)).

That is so for u + v <= h + 2 k: at a signal of the high sum after n samples the values less the mean sum to
more than h - u + n k, so the low one is below v + u - h - 2 n k. For a head start beyond h / 2 + k there is no such
formula, and the function raises.

In the steady state L is averaged over the sums as they are after long without a signal. It is linear in L+(u) and
L-(v), so the distribution of each sum by itself is all that is needed. It is taken as that of a one-sided chart, which
leaves out that the other side has not signalled either: less than 0.1 % of the run length if a false alarm comes every
100 samples or less often, 0.5 % at every 20 (held against the chain of both sums in the tests).
"""

from functools import cache
from math import ceil, isinf, log, sqrt
from typing import Self

import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.charts.base import Baseline, Design, Judgement, Setting, Shown, finite
from reactorwatch.spc.compiled_chart import PRESENT, SETTINGS, CompiledChart, X, write_point
from reactorwatch.spc.false_alarm_budget import TrainingErrors, scale_variance
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

CEILING = 2.0
"""Times the limit: the sums stop there, so that after a large change they are soon back. Run lengths are untouched."""

LARGEST_LIMIT = 200.0
"""Largest limit whose run length is computed: its integral equation then has 640 nodes."""

_MEAN, _ALLOWANCE, _LIMIT, _START = range(SETTINGS, SETTINGS + 4)
_HIGH, _LOW, _END = range(_START + 2, _START + 2 + 3)


@jit
def _judge(columns: Array) -> None:
    for p in range(columns.shape[1]):
        present = columns[PRESENT, p] > 0.0
        allowance, limit = columns[_ALLOWANCE, p], columns[_LIMIT, p]
        off = columns[X, p] - columns[_MEAN, p]
        high = min(max(0.0, columns[_HIGH, p] + off - allowance), CEILING * limit)
        low = min(max(0.0, columns[_LOW, p] - off - allowance), CEILING * limit)
        columns[_HIGH, p] = high if present else columns[_HIGH, p]
        columns[_LOW, p] = low if present else columns[_LOW, p]
        statistic = high if high >= low else -low
        write_point(columns, p, statistic, 0.0, -limit, limit, 1.0 if max(high, low) > limit else 0.0)


class Cusum(CompiledChart):
    """Two-sided cumulative sums of the deviations beyond an allowance.

    >>> chart = Cusum(mean=0.0, sigma=1.0, k=0.5, h=4.0)
    >>> [chart.update(x).out for x in (2.0, 2.0, 2.0)]
    [False, False, True]

    Args:
        mean: mean of the values when all is well.
        sigma: standard deviation of the values when all is well.
        k: the allowance in sigma; half the change that matters.
        h: the limit in sigma.
        head_start: initial value of both sums, in sigma; often h / 2.

    Raises:
        InputError: sigma or h is not a positive number, k is negative, head_start is not in [0, h].
    """

    name = "cusum"
    settings = (Setting("cusum_allowance", 0.25, 0.05, 5.0),)
    memories = 2
    numbers = _END - SETTINGS
    kernel = staticmethod(_judge)

    def __init__(self, mean: float, sigma: float, k: float = 0.5, h: float = 5.0, head_start: float = 0.0) -> None:
        positive("sigma", sigma)
        _check(k, h, head_start)
        start = head_start * sigma
        super().__init__([finite(mean), k * sigma, h * sigma], [start, start])

    @classmethod
    def fastest(cls, arl0: float, shift: float, dimension: int, rules: tuple[int, ...]) -> Design:
        """See `Chart`."""
        largest = 0.98 * float(-special.ndtri(0.5 / arl0))  # beyond it even a limit of 0 signals too seldom
        k = fastest_parameter(
            lambda k: cusum_run_length(shift, k, cusum_limit(arl0, k)),
            min(0.35 * shift, 0.7 * largest),
            min(0.75 * shift, largest),
        )
        h = cusum_limit(arl0, k)
        return Design(cls.name, {"k": k, "h": h}, arl0, shift, cusum_run_length(shift, k, h))

    @classmethod
    def design(cls, baseline: Baseline) -> Self:
        """See `SignalChart`; `cusum_allowance` is k."""
        (learned,), (sd,), k = baseline.learned, baseline.memory_sd, baseline.settings["cusum_allowance"]
        return cls(0.0, sd, k, designed_limit(baseline.arl0, k, learned))

    @classmethod
    def relative_rates(cls, baseline: Baseline, errors: TrainingErrors) -> Array:
        """See `SignalChart`; after Siegmund, as for the limit."""
        (learned,), k = baseline.learned, baseline.settings["cusum_allowance"]
        known, h = cusum_limit(baseline.arl0, k), designed_limit(baseline.arl0, k, learned)
        scale = errors.true_scale(0, learned, 0.0)
        rate = _cusum_rate(errors.mean[:, 0] / sqrt(learned.rows), k / scale, h / scale)
        return rate / _cusum_rate(np.zeros(1), np.full(1, k), np.full(1, known))

    @classmethod
    def explain(cls, judgement: Judgement, signal: Shown) -> tuple[str, dict[str, float]]:
        """See `SignalChart`."""
        return f"{signal.name} has been {judgement.side} what the model expects for long", {signal.name: 1.0}


def designed_limit(arl0: float, k: float, learned: Prewhitening) -> float:
    """The limit h of a two-sided CUSUM with the allowance k, in standard deviations.

    An error of the mean does not add to a CUSUM as it does to an average, so here the rate of false alarms is averaged
    over the errors that the training may have made. Siegmund's approximation (1985, Sequential Analysis,
    sec. 2.6) gives its change with them; it costs nothing and is good where run lengths are long.

    Args:
        arl0: run length of the chart without a fault.
        k: the allowance.
        learned: the training.
    """
    from scipy import optimize  # only here: to import it is a tenth of a start

    places, weights = np.polynomial.hermite_e.hermegauss(15)
    shift, log_scale = np.meshgrid(places / sqrt(learned.rows), places * sqrt(scale_variance(learned, 0.0)))
    share = np.outer(weights, weights) / weights.sum() ** 2
    scale = np.exp(log_scale)
    known = cusum_limit(arl0, k)

    def off(h: float) -> float:
        return log(float(np.sum(share * _cusum_rate(shift / scale, k / scale, h / scale))) / wanted)

    wanted = float(_cusum_rate(np.zeros(1), np.full(1, k), np.full(1, known))[0])
    beyond = 10.0 * known + 10.0
    while off(beyond) > 0.0:  # after a training of few rows; the rate falls with 1 / h, so this comes to an end
        beyond *= 10.0
    return float(optimize.brentq(off, known, beyond, xtol=1e-6 * known))


def _cusum_rate(shift: Array, k: Array, h: Array) -> Array:
    """Rate of signals of a two-sided CUSUM, a row, after Siegmund."""
    rate = np.zeros(shift.shape)
    for side in (1.0, -1.0):
        off = side * shift - k
        off = np.where(np.abs(off) < 1e-6, 1e-6, off)
        exponent = np.minimum(-2.0 * off * (h + 1.166), 700.0)
        rate += 2.0 * off * off / (np.exp(exponent) - exponent - 1.0)
    return rate


@cache
def cusum_limit(arl0: float, k: float) -> float:
    """Limit h of the two-sided CUSUM of allowance k for an in-control run length."""
    # The run length grows about as exp(2 k h).
    step = 0.5 / min(max(k, 0.01), 1.0)
    return limit_for(arl0, lambda h: cusum_run_length(0.0, k, h), step, LARGEST_LIMIT)


def cusum_run_length(
    shift: float,
    k: float = 0.5,
    h: float = 5.0,
    head_start: float = 0.0,
    *,
    one_sided: bool = False,
    steady_state: bool = False,
) -> float:
    """Average run length of a CUSUM.

    >>> round(cusum_run_length(1.0, k=0.5, h=5.0), 2)
    10.38

    Args:
        shift: shift of the mean, in sigma; its sign counts for the one-sided chart only.
        k: allowance, in sigma.
        h: limit, in sigma, at most 200.
        head_start: initial value of both sums, in sigma.
        one_sided: whether there is the high sum only.
        steady_state: whether the chart has long run when the shift occurs; the head start is forgotten then.

    Raises:
        InputError: an argument out of its range.
    """
    _check(k, h, head_start)
    check_range("h", h, 1e-3, LARGEST_LIMIT)
    check_range("k", k, 0.0, 100.0)
    size = shift_size(shift)
    if one_sided:
        return check_length(_one_side(shift, k, h, head_start, steady_state)[1])
    if head_start > 0.5 * h + k and not steady_state:
        raise InputError(f"head_start must be at most h/2 + k = {0.5 * h + k:g} for two sides, got {head_start}")
    high_0, high = _one_side(size, k, h, head_start, steady_state)
    low_0, low = _one_side(-size, k, h, head_start, steady_state)
    if isinf(low_0):
        return check_length(high)
    return check_length((high * low_0 + low * high_0 - high_0 * low_0) / (high_0 + low_0))


def _check(k: float, h: float, head_start: float) -> None:
    """Check the parameters of a chart.

    Raises:
        InputError: one is out of its range.
    """
    positive("h", h)
    if not 0.0 <= k < float("inf"):
        raise InputError(f"k must be a number of at least 0, got {k}")
    if not 0.0 <= head_start <= h:
        raise InputError(f"head_start must be in [0, h] = [0, {h}], got {head_start}")


def _one_side(shift: float, k: float, h: float, head_start: float, steady_state: bool) -> tuple[float, float]:
    """Run length of the high sum from 0, and from the head start or in the steady state."""
    states = np.concatenate([[0.0], _nodes(h)[0]])
    lengths = run_lengths(_transitions(states, shift, k, h))
    at_zero = float(lengths[0])
    if isinf(at_zero):
        return at_zero, at_zero
    if steady_state:
        return at_zero, float(stationary_distribution(_transitions(states, 0.0, k, h)) @ lengths)
    if head_start == 0.0:
        return at_zero, at_zero
    return at_zero, float(1.0 + _transitions(np.array([head_start]), shift, k, h)[0] @ lengths)


def _transitions(states: Array, shift: float, k: float, h: float) -> Array:
    """Transitions from the given sums to 0 and to the nodes."""
    points, weights = _nodes(h)
    to_zero = special.ndtr(k - shift - states)
    off = points[None, :] + (k - shift - states)[:, None]
    return np.column_stack([to_zero, weights * np.exp(-0.5 * off * off) / np.sqrt(2.0 * np.pi)])


def _nodes(h: float) -> tuple[Array, Array]:
    return nodes(0.0, h, 32 + ceil(3.0 * h))
