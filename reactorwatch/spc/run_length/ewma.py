"""Run length of the two-sided EWMA, by its integral equation.

Crowder (1987), A simple method for studying run-length distributions of EWMA charts, Technometrics 29(4).

In units of sigma from the mean, with the limit H = L sqrt(lambda / (2 - lambda)) and the average at u

    L(u) = 1 + 1/lambda integral from -H to H of L(y) phi((y - (1 - lambda) u) / lambda - shift) dy.

With exact limits H depends on the number of samples t; L_t follows from L_(t+1) by the same integral, backwards from
the converged limit.
"""

from math import ceil, log, sqrt

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.run_length.arguments import check_length, check_range, shift_size
from reactorwatch.spc.run_length.chain import nodes, run_lengths, stationary_distribution

SMALLEST_WEIGHT = 1e-3
LARGEST_LIMIT = 10.0


def ewma(
    shift: float,
    weight: float = 0.2,
    limit: float = 3.0,
    *,
    exact_limits: bool = False,
    steady_state: bool = False,
) -> float:
    """Average run length.

    >>> round(ewma(1.0, weight=0.25, limit=3.0), 6)
    11.154267

    Args:
        shift: shift of the mean, in sigma.
        weight: lambda, in [0.001, 1].
        limit: L, in standard deviations of the average.
        exact_limits: whether the limits grow with the average's standard deviation from the start.
        steady_state: whether the chart has long run when the shift occurs.

    Raises:
        InputError: an argument out of its range.
    """
    check_parameters(weight, limit)
    check_range("weight (lambda)", weight, SMALLEST_WEIGHT, 1.0)
    check_range("limit", limit, 1e-3, LARGEST_LIMIT)
    size = shift_size(shift)
    bound = limit * sqrt(weight / (2.0 - weight))
    count = 40 + ceil(6.0 * bound / weight)
    points, weights = nodes(-bound, bound, count)
    lengths = run_lengths(_kernel(points, points, size, weight) * weights)
    check_length(float(lengths[count // 2]))
    if steady_state:
        return float(stationary_distribution(_kernel(points, points, 0.0, weight) * weights) @ lengths)
    if exact_limits:
        return _with_exact_limits(size, weight, bound, count, points, lengths)
    return float(1.0 + _kernel(np.zeros(1), points, size, weight)[0] * weights @ lengths)


def check_parameters(weight: float, limit: float) -> None:
    """Check the parameters of a chart.

    Raises:
        InputError: one is out of its range.
    """
    if not 0.0 < weight <= 1.0:
        raise InputError(f"weight (lambda) must be in (0, 1], got {weight}")
    positive("limit", limit)


def _kernel(start: Array, end: Array, shift: float, weight: float) -> Array:
    """Density of the next average at `end`, from each `start`, shape (starts, ends)."""
    off = (end[None, :] - (1.0 - weight) * start[:, None]) / weight - shift
    return np.asarray(np.exp(-0.5 * off * off) / (np.sqrt(2.0 * np.pi) * weight))


def _with_exact_limits(shift: float, weight: float, bound: float, count: int, points: Array, lengths: Array) -> float:
    """Run length with exact limits, backwards from the sample at which the limit is within 1e-9 of its final value."""
    if weight == 1.0:
        return float(lengths[0])
    unit, unit_weights = nodes(-1.0, 1.0, count)
    weights = bound * unit_weights
    for t in range(ceil(log(1e-9) / (2.0 * log(1.0 - weight))), 0, -1):
        bound_before = bound * sqrt(1.0 - (1.0 - weight) ** (2 * t))
        before = bound_before * unit
        lengths = 1.0 + (_kernel(before, points, shift, weight) * weights) @ lengths
        points, weights = before, bound_before * unit_weights
    return float(1.0 + (_kernel(np.zeros(1), points, shift, weight) * weights)[0] @ lengths)
