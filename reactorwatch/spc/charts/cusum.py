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

from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError
from reactorwatch.spc.charts.base import (
    CENTRE,
    LOWER,
    OUT,
    PRESENT,
    SETTINGS,
    STATISTIC,
    UPPER,
    Array,
    SignalChart,
    X,
    finite,
    positive,
)

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
        columns[STATISTIC, p] = high if high >= low else -low
        columns[CENTRE, p] = 0.0
        columns[LOWER, p] = -limit
        columns[UPPER, p] = limit
        columns[OUT, p] = 1.0 if max(high, low) > limit else 0.0


class Cusum(SignalChart):
    """Two-sided cumulative sums of the deviations beyond an allowance.

    >>> chart = Cusum(mean=0.0, sigma=1.0, k=0.5, h=4.0)
    >>> [chart.update(x).out for x in (2.0, 2.0, 2.0)]
    [False, False, True]

    Args:
        mean: of the values when all is well.
        sigma: their standard deviation.
        k: the allowance in sigma; half the change that matters.
        h: the limit in sigma.
        head_start: where both sums start, in sigma; often h / 2.

    Raises:
        InputError: sigma or h is not a positive number, k is negative, head_start is not in [0, h].
    """

    name = "cusum"
    memories = _MEMORIES
    numbers = _END - SETTINGS
    kernel = staticmethod(_judge)

    def __init__(self, mean: float, sigma: float, k: float = 0.5, h: float = 5.0, head_start: float = 0.0) -> None:
        positive("sigma", sigma)
        check(k, h, head_start)
        start = head_start * sigma
        super().__init__([finite(mean), k * sigma, h * sigma], [start, start])


def check(k: float, h: float, head_start: float) -> None:
    """Whether the parameters make a chart.

    Raises:
        InputError: they don't; the text names which and why.
    """
    positive("h", h)
    if not 0.0 <= k < float("inf"):
        raise InputError(f"k must be a number of at least 0, got {k}")
    if not 0.0 <= head_start <= h:
        raise InputError(f"head_start must be in [0, h] = [0, {h}], got {head_start}")
