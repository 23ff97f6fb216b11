"""Resolution of a signal: the smallest step between two of its values.

A sensor with steps of q has an error of up to q / 2. If uniform in that range, it has the standard deviation
q / sqrt(12) (Sheppard 1898, On the calculation of the most probable values of frequency-constants for data arranged
according to equidistant divisions of a scale, Proc. London Math. Soc. 29). Residuals of the sensor are no smaller. A
signal of n values without steps has neighbours about 1 / n^2 of its range apart, which is as good as none.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

SAME = 1e-12
"""Share of the largest value: a smaller difference is a rounding error."""


def resolution(values: NDArray[np.float64]) -> float:
    """Smallest step between two values; 0 if there is none.

    >>> round(resolution(np.array([1.2, 0.9, 0.3, 0.3 + 1e-16])), 9)
    0.3

    Args:
        values: values of the signal, shape (n,); NaN where missing.
    """
    levels = np.unique(values[np.isfinite(values)])
    steps = np.diff(levels)
    steps = steps[steps > SAME * np.max(np.abs(levels), initial=0.0)]
    return float(steps.min()) if steps.size else 0.0


def resolution_sd(values: NDArray[np.float64], stated: float | None = None) -> float:
    """Standard deviation of a signal's residual due to its steps alone.

    Args:
        values: values of the signal, shape (n,); NaN where missing.
        stated: resolution of the signal; None: it is learned.
    """
    return (resolution(values) if stated is None else stated) / sqrt(12.0)
