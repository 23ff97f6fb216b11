"""Tests of the residuals of a model: whiteness, and independence from past inputs.

Whiteness: Ljung and Box (Biometrika 65 (1978) 297), Q = N (N+2) sum_k r_k^2 / (N-k), r_k the autocorrelation of the
residuals at lag k, is chi-squared with as many degrees of freedom as lags, less the number of fitted parameters on the
output's own past, if the residuals are white.

Independence from past inputs: Soderstrom and Stoica (System Identification, 1989, section 11.2),
x = N r' R^-1 r with r the cross-covariances of residual and past inputs over the residuals' standard deviation and R
the covariance matrix of these past inputs, is chi-squared with as many degrees of freedom as there are of them.

The result is -log10 p, with p the probability of such a statistic under a true model: 6 is one in a million, and it
stays finite where p itself underflows.
"""

import math

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.regressor import consecutive_rows
from reactorwatch.identification.structure import as_columns

DEFAULT_LAGS = 20


class ResidualTest(msgspec.Struct, frozen=True):
    """Result of a test of residuals.

    Attributes:
        name: "whiteness" or "independence".
        statistic: test statistic, chi-squared under the null hypothesis.
        degrees: degrees of freedom.
        minus_log10_p: -log10 of its p-value; 0 when there are no residuals.
    """

    name: str
    statistic: float
    degrees: int
    minus_log10_p: float


def whiteness(residuals: ArrayLike, lags: int = DEFAULT_LAGS, fitted: int = 0) -> ResidualTest:
    """Ljung-Box test of whiteness.

    Args:
        residuals: shape (rows,), NaN where there is none; pairs with a missing one are excluded.
        lags: number of autocorrelations.
        fitted: parameters on the output's own past that were fitted to these residuals (an ARX model's `a`).

    Raises:
        InputError: lags that leave no degree of freedom, or fewer than two residuals a lag.
    """
    if lags <= fitted or lags < 1:
        raise InputError(f"lags must be above the {fitted} fitted parameters and at least 1, got {lags}")
    values, present = _centre(residuals, lags)
    count = int(present.sum())
    variance = float(np.sum(values * values))
    if variance == 0.0:
        return ResidualTest("whiteness", 0.0, lags - fitted, 0.0)
    statistic = 0.0
    for lag in range(1, lags + 1):
        pairs = int(np.sum(present[lag:] & present[:-lag]))
        if pairs:
            correlation = float(values[lag:] @ values[:-lag]) / variance
            statistic += correlation**2 / pairs
    statistic *= count * (count + 2.0)
    return ResidualTest("whiteness", statistic, lags - fitted, minus_log10_p(statistic, lags - fitted))


def independence(
    residuals: ArrayLike,
    inputs: ArrayLike,
    delay: int = 1,
    lags: int = DEFAULT_LAGS,
    time: ArrayLike | None = None,
) -> ResidualTest:
    """Test that the residuals are uncorrelated with past inputs.

    Args:
        residuals: shape (rows,), NaN where there is none.
        inputs: shape (rows,) or (rows, inputs).
        delay: the first lag of the inputs that is tested.
        lags: number of lags of each input.
        time: shape (rows,); None: gaps are not detected.

    Raises:
        InputError: fewer than two residuals a lag, or a delay or number of lags below 1.
    """
    if delay < 1 or lags < 1:
        raise InputError(f"delay and lags must be at least 1, got {delay} and {lags}")
    values, present = _centre(residuals, lags)
    u = as_columns(inputs, "inputs")
    if len(u) != values.size:
        raise InputError(f"residuals and inputs must have equally many rows, got {values.size} and {len(u)}")
    reach = delay + lags - 1
    rows = np.flatnonzero(present & (np.concatenate([[0], consecutive_rows(u, time)[:-1]]) >= reach))
    if rows.size <= reach:
        raise UnfitRecordError(
            f"{lags} lags need more than {reach} rows with a residual and past inputs, got {rows.size}"
        )
    past = np.concatenate([u[rows - lag] for lag in range(delay, delay + lags)], axis=1)
    past = past - past.mean(axis=0)
    # A constant or duplicate input adds no direction; the projection counts independent ones.
    directions, sizes, _ = np.linalg.svd(past, full_matrices=False)
    directions = directions[:, sizes > 1e-9 * max(sizes[0], 1e-300)]
    errors = values[rows]
    variance = float(np.mean(errors * errors))
    degrees = directions.shape[1]
    if variance == 0.0 or degrees == 0:
        return ResidualTest("independence", 0.0, degrees, 0.0)
    statistic = float(np.sum((directions.T @ errors) ** 2)) / variance
    return ResidualTest("independence", statistic, degrees, minus_log10_p(statistic, degrees))


def minus_log10_p(statistic: float, degrees: int) -> float:
    """-log10 of the upper tail of chi-squared, for any tail however small.

    Beyond double range it is the continued fraction of the incomplete gamma function, DLMF 8.9.2, in logarithms.

    Args:
        statistic: value of chi-squared, at least 0.
        degrees: degrees of freedom, at least 1.
    """
    from scipy.special import gammaincc, gammaln

    a, x = 0.5 * degrees, 0.5 * statistic
    probability = float(gammaincc(a, x))
    if probability > 1e-200:
        return abs(math.log10(probability))
    # Lentz's method (Numerical Recipes, 3rd ed., section 6.2) for x well above a, where it converges in a few steps.
    b = x + 1.0 - a
    c, d = 1e300, 1.0 / b
    fraction = d
    for i in range(1, 1000):
        term = -i * (i - a)
        b += 2.0
        d = 1.0 / (term * d + b)
        c = b + term / c
        fraction *= d * c
        if abs(d * c - 1.0) < 1e-15:
            break
    return (x - a * math.log(x) + float(gammaln(a)) - math.log(fraction)) / math.log(10.0)


def _centre(residuals: ArrayLike, lags: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Residuals less their mean, 0 where missing, and a mask of those present."""
    values = np.asarray(residuals, dtype=np.float64)
    if values.ndim != 1:
        raise InputError(f"residuals must have the shape (rows,), got {values.shape}")
    present = np.isfinite(values)
    if present.sum() < 2 * lags:
        raise UnfitRecordError(f"{lags} lags need at least {2 * lags} residuals, got {int(present.sum())}")
    return np.where(present, values - np.mean(values[present]), 0.0), present
