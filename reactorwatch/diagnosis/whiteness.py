"""Whiteness test of the normalised innovations.

For each output, the autocorrelations over `LAGS` rows are tested together (Ljung & Box 1978, On a measure of lack of
fit in time series models, Biometrika 65), and so are the correlations with the changes of the inputs in the last `LAGS`
rows (Hosking 1980, The multivariate portmanteau statistic, J. American Statistical Association 75, has the sum of
squares that this is part of), without that in the same row, because a controller may have answered. The smaller p-value
counts, times the number of tests. Large values are clipped, so that a few outliers do not decide.
"""

from math import log

import numpy as np
from scipy import special

from reactorwatch.arrays import Array

LAGS = 20
CUT = 4.0
"""Standard deviations at which values are clipped."""

BURN_IN_ROWS = 20
WHITE = 6.0
"""Minus the decimal logarithm of the p-value beyond which innovations are not white; a search tests many hypotheses."""

DOUBTFUL = 3.0
"""Minus the decimal logarithm of the p-value beyond which the search looks for another explanation."""

LARGEST = 999.0


def minus_log10_p(w: Array, inputs: Array) -> Array:
    """Minus the decimal logarithm of the p-value that each output's innovations are white, shape (n_y,).

    Args:
        w: normalised innovations, shape (rows, n_y); NaN where not measured.
        inputs: shape (rows, n_u).
    """
    changes = np.diff(inputs, axis=0)[BURN_IN_ROWS - 1 :]
    result = []
    for column in w[BURN_IN_ROWS:].T:
        finite = np.isfinite(column)
        z = np.where(finite, np.clip(column, -CUT, CUT), 0.0)
        z = np.where(finite, z - z[finite].mean() if finite.any() else 0.0, 0.0)
        logs = [_log_sf(_squares(z, z, first=1))]
        logs += [_log_sf(_squares(z, change - change.mean(), first=1)) for change in changes.T if np.ptp(change) > 0.0]
        result.append(min(max(-(min(logs) + log(len(logs))) / log(10.0), 0.0), LARGEST))
    return np.array(result)


def _squares(z: Array, past: Array, first: int) -> float:
    """Sum of `LAGS` squared correlations of z with the past, each over its variance by chance."""
    n, total = z.size, 0.0
    scale = float(np.sum(z * z) * np.sum(past * past))
    if scale <= 0.0 or n <= 2 * LAGS:
        return 0.0
    for lag in range(first, first + LAGS):
        total += float(np.sum(z[lag:] * past[: n - lag])) ** 2 / scale * n * (n + 2) / (n - lag)
    return total


def _log_sf(statistic: float) -> float:
    """Logarithm of the upper tail of the chi-square distribution with `LAGS` degrees of freedom.

    For an even number of degrees it is a sum of Poisson probabilities (Abramowitz & Stegun 1964, 26.4.21).
    `scipy.stats` has it only as far as the tail itself does not underflow, and takes half a second to import.

    >>> round(_log_sf(31.4104328442309), 9) == round(log(0.05), 9)
    True
    """
    mean = 0.5 * statistic
    count = np.arange(LAGS // 2)
    return float(special.logsumexp(special.xlogy(count, mean) - special.gammaln(count + 1.0)) - mean)
