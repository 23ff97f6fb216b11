"""Limit of the chart on parameters whose covariance and reference come from a finite training.

If covariance and reference were known, the difference u of the parameters, made white, would be a MEWMA of weight w
with the rate of false alarms rate(h) = 1 / ARL at the limit h. Neither is known.

*The covariance* comes from a training with nu degrees of freedom. The statistic of a normal vector v is then
|v|^2 / G with G independent of |v|, chi-square with nu - p + 1 degrees of freedom over nu (that is Hotelling's F;
Mardia, Kent & Bibby, Multivariate Analysis, 1979, section 3.5).

*The reference* has a constant error d, of r times the variance of u: the chart takes u - d, with 1 + r times the
variance. References differ; the rate of false alarms holds on average over the references. A rare alarm of an average
whose weight is small comes when u is carried out over the boundary of the region within the limit. As u falls back
towards 0 at the speed w u, in balance as many cross the boundary outwards for the first time as would drift inwards
there (the flux that gives Kramers' escape rate), and by Gauss's theorem that is, with all that is random in u, d and G
averaged over,

    w E[(|u|^2 - p) 1(out)].

Given v = (u - d) / sqrt(1 + r), the mean of |u|^2 - p is (|v|^2 - p) / (1 + r). So the average rate of false alarms at
the limit L of |v|^2 / G is that of the known chart, at the limits L G, over 1 + r:

    E_G[rate(L G)] / (1 + r).

This is the rate at which the statistic leaves its usual range. With a reference so poor that the statistic is usually
beyond the limit, there is one lasting false alarm.
"""

from collections.abc import Iterator
from functools import lru_cache
from math import inf, isfinite, log

import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.spc.run_length.arguments import check_range
from reactorwatch.spc.run_length.control_limits import LONGEST_DESIGN, SHORTEST
from reactorwatch.spc.run_length.mewma import LARGEST_LIMIT, mewma

_FIRST_HEIGHT, _HEIGHT_RATIO = 0.5, 1.25
_LARGEST_LEARNED_LIMIT = 1e6


def parameter_limit(arl0: float, dimension: int, weight: float, freedom: float, reference_share: float) -> float:
    """Limit of the statistic.

    Args:
        arl0: rows to a false alarm, averaged over the references.
        dimension: number of charted directions, p.
        weight: weight w of the newest row in the adaptive model.
        freedom: degrees of freedom nu of the learned covariance; at least p.
        reference_share: r, variance of the reference over that of the adaptive model.

    Raises:
        InputError: an argument out of its range, or a training so short that no limit gives that run length.
    """
    from scipy import optimize  # imported here, as it takes a tenth of a start

    check_range("arl0", arl0, SHORTEST * (1.0 + reference_share), LONGEST_DESIGN)
    rates = _rates(dimension, weight)
    half = 0.5 * (freedom - dimension + 1.0)
    # All but 1e-20 of the distribution of half of nu G; even steps of the log of it, so that small ones are there too.
    log_half = np.linspace(log(special.gammaincinv(half, 1e-20)), log(special.gammainccinv(half, 1e-20)), 2001)
    share = np.exp(half * (log_half - log(half)) - np.exp(log_half) + half)
    share /= share.sum()
    log_g = log_half - log(0.5 * freedom)

    def off(log_limit: float) -> float:
        return log(float(share @ np.exp(rates(log_limit + log_g)))) + log(arl0 / (1.0 + reference_share))

    largest = log(_LARGEST_LEARNED_LIMIT)
    if off(largest) > 0.0:
        raise InputError(f"arl0 must be lower, or the training longer: it has {freedom:g} degrees of freedom")
    return float(np.exp(optimize.brentq(off, log(_FIRST_HEIGHT), largest, xtol=1e-6)))


def prepare_limit(dimension: int, weight: float) -> Iterator[None]:
    """Compute what `parameter_limit` takes seconds for, up to half a second for each item of the iterator.

    Args:
        dimension: see there.
        weight: see there.
    """
    is_known = False
    for _ in _known_chart(dimension, weight):
        is_known = True
        yield
    if not is_known:  # an argument is out of its range, which `parameter_limit` reports
        return
    from scipy import interpolate, optimize  # noqa: F401 # the imports that `parameter_limit` needs

    yield
    _rates(dimension, weight)


class _Rates:
    """Logarithm of the rate of false alarms of a known chart as a function of the logarithm of its limit."""

    def __init__(self, dimension: int, weight: float) -> None:
        from scipy import interpolate  # imported here, as it takes a tenth of a start

        known = list(_known_chart(dimension, weight))
        if not known:
            mewma(0.0, dimension, weight, _FIRST_HEIGHT)  # raises: an argument is out of its range
        heights, rates = zip(*known, strict=True)
        self._last = heights[-1]
        self._inside = interpolate.CubicSpline(heights, rates)
        self._slope = float(self._inside(self._last, 1))

    def __call__(self, log_height: Array) -> Array:
        """Evaluate; constant below the first height, where the rate exceeds any that is asked for."""
        inside = self._inside(np.clip(log_height, log(_FIRST_HEIGHT), self._last))
        return np.asarray(inside + self._slope * np.maximum(log_height - self._last, 0.0))


def _known_chart(dimension: int, weight: float) -> Iterator[tuple[float, float]]:
    """Logarithms of a limit and the rate there, for growing limits up to the longest run length."""
    height = _FIRST_HEIGHT
    while height < LARGEST_LIMIT and isfinite(rate := _log_rate(dimension, weight, height)):
        yield log(height), rate
        height *= _HEIGHT_RATIO


@lru_cache(maxsize=512)
def _log_rate(dimension: int, weight: float, height: float) -> float:
    """Logarithm of the rate of a known chart; -inf beyond the longest run length that can be computed."""
    try:
        return -log(mewma(0.0, dimension, weight, height))
    except InputError:
        return -inf


@lru_cache(maxsize=16)
def _rates(dimension: int, weight: float) -> _Rates:
    return _Rates(dimension, weight)
