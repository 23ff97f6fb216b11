"""The cumulative sum: sees a small lasting change soonest.

Page (1954), Continuous inspection schemes, Biometrika 41; two-sided and with a head start: Lucas & Crosier (1982), Fast
initial response for CUSUM quality-control schemes, Technometrics 24(3). With y = x - mean

    high <- max(0, high + y - k sigma)      low <- max(0, low - y - k sigma)      out: either above h sigma.

Each sum counts how far the values have been beyond the mean by more than the allowance k. With k half the change that
matters, no test with the same rate of false alarms finds that change faster in the worst case (Moustakides 1986). The
sums start at 0 or, for a fast first response, at `head_start`: a fault that is there at the start is then found in
half the time, and without one the sums are soon back at 0.

The statistic is the larger of the two sums, negative if it is the low one, in the units of the values.
"""

from math import log, sqrt
from typing import Self

import numpy as np

from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import positive
from reactorwatch.spc import false_alarm_budget
from reactorwatch.spc.baseline import Baseline
from reactorwatch.spc.charts.base import Array, Judgement, Setting, Shown, finite
from reactorwatch.spc.compiled_chart import PRESENT, SETTINGS, CompiledChart, X, write_point
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.run_length.control_limits import cusum_limit
from reactorwatch.spc.run_length.cusum import check_parameters
from reactorwatch.spc.training_errors import TrainingErrors

CEILING = 2.0
"""Times the limit: the sums stop there, so that after a large change they are soon back. Run lengths are untouched."""

_MEMORIES = 2
_MEAN, _ALLOWANCE, _LIMIT, _START = range(SETTINGS, SETTINGS + 4)
_HIGH, _LOW, _END = range(_START + _MEMORIES, _START + _MEMORIES + 3)


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
    memories = _MEMORIES
    numbers = _END - SETTINGS
    kernel = staticmethod(_judge)

    def __init__(self, mean: float, sigma: float, k: float = 0.5, h: float = 5.0, head_start: float = 0.0) -> None:
        positive("sigma", sigma)
        check_parameters(k, h, head_start)
        start = head_start * sigma
        super().__init__([finite(mean), k * sigma, h * sigma], [start, start])

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
    shift, log_scale = np.meshgrid(
        places / sqrt(learned.rows), places * sqrt(false_alarm_budget.scale_variance(learned, 0.0))
    )
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
