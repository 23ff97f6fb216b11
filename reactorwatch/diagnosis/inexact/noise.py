"""Coloured discrepancy of an output: what no hypothesis explains, and the noise of its sensor.

A first-order coloured discrepancy with white noise is an ARMA(1, 1) process, (1 - a L) r = (1 - b L) e, so the filter
that undoes it makes the residual and its derivatives white at once. The same levels hold for all hypotheses.
"""

from dataclasses import dataclass
from math import log, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

from reactorwatch.arrays import Array

POLES = (0.3, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995)
ZEROS = (0.0, 0.3, 0.6, 0.8, 0.9, 0.95)
"""Values of a and b that are tried; b is less than a: a discrepancy is slower than noise."""

COLOURED = 10.0
"""Gain of log likelihood beyond which a residual is taken for coloured: odds of 20,000 to one."""

SMALLEST = 1e-12


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """ARMA(1, 1) of each output: `a`, `b` and the standard deviation of e, each of shape (n_y,)."""

    a: Array
    b: Array
    sd: Array

    def of(self, outputs: NDArray[np.bool_]) -> "Discrepancy":
        """That of some outputs."""
        return Discrepancy(self.a[outputs], self.b[outputs], self.sd[outputs])

    def whiten(self, values: Array) -> Array:
        """Whiten residuals or their derivatives, shape (rows, n_y, ...), in the standard deviation of e."""
        result = np.empty_like(values)
        for j, (a, b, sd) in enumerate(zip(self.a, self.b, self.sd, strict=True)):
            result[:, j] = filter_first_order(values[:, j], 1.0, -a, b) / sd
        return result


def filter_first_order(x: Array, now: float, before: float, pole: float, start: Array | float = 0.0) -> Array:
    """Filter y_t = pole y_{t-1} + now x_t + before x_{t-1} along the first axis, the first row with `start` added.

    `scipy.signal` has it, and takes half a second to import.
    """
    driven = now * x
    driven[1:] += before * x[:-1]
    driven[:1] += start
    if not pole:
        return driven
    bands, columns = np.array([np.ones(len(x)), np.full(len(x), -pole)]), driven.reshape(len(x), -1)
    return np.asarray(dtbtrs(bands, columns, uplo="L", diag="U")[0].reshape(x.shape))


def white(sd: Array) -> Discrepancy:
    """White noise with these standard deviations."""
    return Discrepancy(np.zeros(sd.size), np.zeros(sd.size), np.maximum(sd, SMALLEST))


def estimate_discrepancy(residual: Array, smallest_sd: Array) -> Discrepancy:
    """ARMA(1, 1) of residuals, shape (rows, n_y), 0 where not measured, by maximum likelihood over a grid."""
    found = []
    for r, least in zip(residual.T, smallest_sd, strict=True):
        n = max(int(np.count_nonzero(r)), 1)
        best = (0.0, 0.0, max(sqrt(float(r @ r) / n), float(least)))
        loss = n * log(best[2]) - COLOURED
        for a in POLES:
            for b in (item for item in ZEROS if item < a):
                e = filter_first_order(r, 1.0, -a, b)
                sd = max(sqrt(float(e @ e) / n), float(least))
                if n * log(sd) < loss:
                    best, loss = (a, b, sd), n * log(sd)
        found.append(best)
    a, b, sd = np.array(found).T
    return Discrepancy(a, b, sd)


def white_noise_sd(measured: Array, discrepancy: Discrepancy) -> Array:
    """Standard deviation of the white noise of each output: from its second differences, or e where that is smaller."""
    second = measured[2:] - 2.0 * measured[1:-1] + measured[:-2]
    count = np.count_nonzero(np.isfinite(second), axis=0)  # none, where an output has values in some rows only
    sd = np.where(count, np.sqrt(np.nansum(second**2, axis=0) / (6.0 * np.maximum(count, 1))), np.inf)
    return np.asarray(np.fmin(sd, discrepancy.sd))
