"""Upper quantile of T2 when scales and correlations of its signals were estimated from a training.

With the true covariance, T2 of p normal signals is chi-square with p degrees of freedom. Two errors of a training widen
it:

- The standard deviation of signal i has the relative variance 1 / (2 nu_i). A signal divided by it is Student's t with
  nu_i degrees of freedom, so the squares of the signals sum to a sum of p independent F(1, nu_i). The density of this
  sum is a convolution, which is computed with the fast Fourier transform on a grid; each F is discretised so that
  its mean is preserved.
- The correlations come from n rows. With the whole covariance estimated, T2 is chi-square times n / chi2(n - p + 1)
  (Hotelling 1931, The generalization of Student's ratio, Ann. Math. Statist. 2). The part of this factor's mean and
  variance that the scales do not explain multiplies the sum.

With one signal this is the square of Student's limit. Hotelling's F with the least nu_i for all signals would be far
too wide for many signals, and does not exist where nu_i < p.
"""

from math import inf, log, sqrt

import numpy as np
from scipy import special

from reactorwatch.arrays import Array

GRID = 2**13
"""Number of grid points; the step is then about a thousandth of the quantile."""

LARGEST_FREEDOM = 1e6
"""Degrees of freedom beyond which they count as infinite."""

LARGEST = 1e7
"""Quantiles beyond this count as infinite: a chart with such a limit detects nothing."""

_LEAST_TAIL = 1e-15  # rounding of the transform
_DEVIATIONS, _NODES = 9.0, 121


def estimated_t2_quantile(tail: float, freedoms: Array, rows: float) -> float:
    """Upper quantile of T2.

    >>> round(estimated_t2_quantile(0.01, np.array([20.0]), 20), 2)  # F(1, 20)
    8.1

    Args:
        tail: probability that T2 exceeds the quantile, above 1e-12.
        freedoms: degrees of freedom of the scales, shape (p,), above 2.
        rows: n, number of rows from which the correlations were estimated; more than p + 1.

    Returns:
        The quantile; infinite if it is beyond `LARGEST`.
    """
    from scipy import optimize  # takes a fifth of a second, which a monitor's start does not need

    p = freedoms.size
    factor, share = _factor(p, rows)
    reach = 4.0 * float(special.chdtri(p, tail))

    def beyond(x: float) -> float:
        return float(share @ np.exp(np.interp(np.minimum(x / factor, at[-1]), at, log_tail)))

    while reach < LARGEST:
        at, log_tail = _sum_tail(freedoms, reach)
        largest = float(at[-1]) * min(1.0, float(factor.min()))
        if beyond(largest) < tail:
            return float(optimize.brentq(lambda x: log(beyond(x) / tail), float(at[1]), largest))
        reach *= 2.0
    return inf


def _factor(p: int, rows: float) -> tuple[Array, Array]:
    """Factor by which estimated correlations widen T2: values and their probabilities."""
    variance = 2.0 / (rows - p + 1.0) - 2.0 / (rows * p)
    mean = (rows - 2.0) / (rows - p - 1.0)
    if p == 1 or variance < 1e-12:
        return np.array([mean]), np.ones(1)
    freedom = max(2.0 / variance, 3.0)
    log_chi2 = np.linspace(-_DEVIATIONS, _DEVIATIONS, _NODES) * sqrt(2.0 / freedom)
    weight = np.exp(0.5 * freedom * (log_chi2 - np.exp(log_chi2) + 1.0))
    return mean * (freedom - 2.0) / freedom * np.exp(-log_chi2), weight / weight.sum()


def _sum_tail(freedoms: Array, reach: float) -> tuple[Array, Array]:
    """A grid up to `reach`, and the logarithm of the probability that the sum of F(1, nu_i) is beyond each point."""
    step = reach / GRID
    at: Array = step * np.arange(GRID + 2, dtype=np.float64)
    transform = np.ones(GRID + 1, dtype=np.complex128)
    for freedom, count in zip(*np.unique(np.minimum(freedoms, LARGEST_FREEDOM), return_counts=True), strict=True):
        # The mean excess over each point; its second differences are the masses that keep the mean.
        below = freedom / (at + freedom)
        excess = freedom / (freedom - 2.0) * special.betainc(0.5 * freedom - 1.0, 1.5, below)
        excess -= at * special.betainc(0.5 * freedom, 0.5, below)
        mass = np.diff(excess, 2, prepend=excess[0]) / step
        mass[0] += 1.0
        transform *= np.fft.rfft(mass, 2 * GRID) ** count
    mass = np.asarray(np.fft.irfft(transform, 2 * GRID)[:GRID], dtype=np.float64)
    log_tail: Array = np.log(np.maximum(1.0 - (np.cumsum(mass) - 0.5 * mass), _LEAST_TAIL))
    return at[:GRID], log_tail
