"""Resolution of a signal: the smallest step between two of its values.

A sensor that shows steps of q is wrong by up to q / 2 whatever it measures; an error that is uniform in that range has
the standard deviation q / sqrt(12) (Sheppard 1898, On the calculation of the most probable values of
frequency-constants for data arranged according to equidistant divisions of a scale, Proc. London Math. Soc. 29). No
residual of the sensor is known better. A signal of n values without steps has neighbours about 1 / n^2 of its range
apart, which is as good as none.
"""

from math import sqrt

import numpy as np
from numpy.typing import NDArray

SAME = 1e-12
"""Of the largest value: by less, two values differ by rounding only."""


def resolution(values: NDArray[np.float64]) -> float:
    """The smallest step between two values; 0 if all are the same, or there are none.

    >>> round(resolution(np.array([1.2, 0.9, 0.3, 0.3 + 1e-16])), 9)
    0.3

    Args:
        values: of the signal, shape (n,); NaN where missing.
    """
    known = np.unique(values[np.isfinite(values)])
    steps = np.diff(known)
    steps = steps[steps > SAME * np.max(np.abs(known), initial=0.0)]
    return float(steps.min()) if steps.size else 0.0


def resolution_sd(values: NDArray[np.float64]) -> float:
    """Standard deviation that a signal's steps alone give its residual.

    Args:
        values: of the signal, shape (n,); NaN where missing.
    """
    return resolution(values) / sqrt(12.0)
