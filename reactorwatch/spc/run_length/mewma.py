"""Run length of the MEWMA, reduced from p to two dimensions.

Runger & Prabhu (1996), A Markov chain model for the multivariate exponentially weighted moving averages control chart,
J. Amer. Statist. Assoc. 91; as an integral equation Rigdon (1995), Statist. Probab. Letters 24. In coordinates in which
the covariance is the unit matrix and the shift lies along the first axis, the average z has a part a along the shift
and a part of length r across it; what direction r has does not matter. The chart has not signalled while
a^2 + r^2 <= R^2 = limit lambda / (2 - lambda). In units of lambda the next a is normal about the present one,

    a' / lambda ~ N((1 - lambda) a / lambda + shift, 1),

and the next r, independent of it, chi with p - 1 degrees of freedom, non-central by (1 - lambda) r / lambda.

Their product is the kernel of an integral equation over half a disc. Where Runger & Prabhu cut the half disc into
cells, it is solved here at Gauss nodes: in a with the weight (R^2 - a^2)^((p-1)/2) and for each a in r^2 with the
weight r^(p-2), which are the volumes that a and r stand for. The remainder is smooth in a and r^2, so some hundred
nodes give five digits. (The Markov chain is kept in the tests, as the independent second method.) Without a shift only
|z| matters, chi with p degrees of freedom, and the equation has one dimension.
"""

from math import ceil, sqrt

import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.errors import positive
from reactorwatch.spc.run_length.arguments import check_length, check_range, shift_size
from reactorwatch.spc.run_length.chain import run_lengths, stationary_distribution
from reactorwatch.spc.run_length.ewma import ewma
from reactorwatch.spc.run_length.t2 import t2

SMALLEST_WEIGHT = 0.01
SMALLEST_WEIGHT_WITHOUT_SHIFT = 1e-4
"""One dimension has so few nodes that a far longer memory can be computed."""
LARGEST_DIMENSION, LARGEST_DIMENSION_WITHOUT_SHIFT = 50, 100
LARGEST_LIMIT, LARGEST_LIMIT_WITHOUT_SHIFT = 200.0, 500.0


def mewma(shift: float, dimension: int, weight: float, limit: float, *, steady_state: bool = False) -> float:
    """Average run length.

    >>> round(mewma(1.0, dimension=2, weight=0.1, limit=8.64), 1)
    10.1

    Args:
        shift: Mahalanobis distance of the shift of the mean.
        dimension: number of signals, p, at most 50; without a shift at most 100.
        weight: lambda, in [0.01, 1]; without a shift in [0.0001, 1].
        limit: H, of the statistic, at most 200; without a shift at most 500.
        steady_state: whether the chart has long run when the shift occurs.

    Raises:
        InputError: an argument out of its range.
    """
    size = shift_size(shift)
    check_range("dimension", dimension, 1, LARGEST_DIMENSION if size > 0.0 else LARGEST_DIMENSION_WITHOUT_SHIFT)
    check_range("weight (lambda)", weight, SMALLEST_WEIGHT if size > 0.0 else SMALLEST_WEIGHT_WITHOUT_SHIFT, 1.0)
    check_range("limit", positive("limit", limit), 1e-6, LARGEST_LIMIT if size > 0.0 else LARGEST_LIMIT_WITHOUT_SHIFT)
    if weight == 1.0:
        return t2(size, dimension, limit)
    # The radius in units of lambda, in which each step has unit variance.
    radius = sqrt(limit / (weight * (2.0 - weight)))
    rest = 1.0 - weight
    if size == 0.0:
        return _without_shift(dimension, rest, radius, steady_state=steady_state)
    if dimension == 1:
        return ewma(size, weight, sqrt(limit), steady_state=steady_state)
    disc = _HalfDisc(radius, dimension - 1)
    transverse = disc.transverse(rest)
    lengths = run_lengths(_normal(rest * disc.along + size, disc.along) * transverse)
    check_length(float(lengths[0]))
    if steady_state:
        return float(stationary_distribution(_normal(rest * disc.along, disc.along) * transverse) @ lengths)
    centre = np.zeros(1)
    first = _normal(centre + size, disc.along) * _chi(centre, disc.across, dimension - 1) * disc.weights
    return float(1.0 + first[0] @ lengths)


def _without_shift(dimension: int, rest: float, radius: float, *, steady_state: bool) -> float:
    at, weights = _radii(dimension, 12 + ceil(1.8 * radius + 0.4 * dimension))
    at, weights = radius * at, radius**dimension * weights
    transitions = _chi(rest * at, at, dimension) * weights
    lengths = run_lengths(transitions)
    check_length(float(lengths[0]))
    if steady_state:
        return float(stationary_distribution(transitions) @ lengths)
    return float(1.0 + (_chi(np.zeros(1), at, dimension) * weights)[0] @ lengths)


class _HalfDisc:
    """Nodes along and across the shift, and their weights, each of shape (nodes,): lines along r, one for each a.

    Lines at a and -a are alike, so the first half of the lines, and the middle one, determine the transverse
    transitions.
    """

    def __init__(self, radius: float, freedom: int) -> None:
        self.freedom = freedom
        # The nodes crowd at the centre the more, the more dimensions there are.
        self.lines = 10 + ceil(2.7 * radius + 0.4 * freedom)
        self.on_line = 6 + ceil(1.35 * radius + 0.2 * freedom)
        line, line_weights = special.roots_gegenbauer(self.lines, 0.5 * (freedom + 1))
        unit, unit_weights = _radii(freedom, self.on_line)
        height = radius * np.sqrt(1.0 - line * line)
        self.along: Array = np.repeat(radius * line, self.on_line)
        self.across: Array = np.outer(height, unit).ravel()
        self.weights: Array = np.outer(radius ** (freedom + 1) * line_weights, unit_weights).ravel()

    def transverse(self, rest: float) -> Array:
        """Density times weight of the next r, shape (nodes, nodes)."""
        half = (self.lines + 1) // 2
        kept = self.across[: half * self.on_line]
        quarter = _chi(rest * kept, kept, self.freedom).reshape(half, self.on_line, half, self.on_line)
        line = np.arange(self.lines)
        mirrored = np.minimum(line, self.lines - 1 - line)
        whole = quarter[mirrored][:, :, mirrored].reshape(self.along.size, self.along.size)
        return np.asarray(whole * self.weights)


def _radii(freedom: int, count: int) -> tuple[Array, Array]:
    """Gauss nodes for even functions on (0, 1) with the weight r^(freedom - 1): Gauss-Jacobi in r^2."""
    at, weights = special.roots_jacobi(count, 0.0, 0.5 * freedom - 1.0)
    return np.sqrt(0.5 * (at + 1.0)), 0.5 ** (0.5 * freedom + 1.0) * weights


def _normal(mean: Array, at: Array) -> Array:
    """Density of a normal number of unit variance, shape (means, at)."""
    off = at[None, :] - mean[:, None]
    return np.asarray(np.exp(-0.5 * off * off) / np.sqrt(2.0 * np.pi))


def _chi(centre: Array, at: Array, freedom: int) -> Array:
    """Density of the length x of a normal vector about a point at distance c, less x^(n-1), shape (centres, at).

    exp(-(x^2 + c^2) / 2) 0F1(n/2; c^2 x^2 / 4) / (2^(n/2 - 1) Gamma(n/2)), with n the degrees of freedom; where
    0F1 would overflow, by the scaled Bessel function that it is.
    """
    order = 0.5 * freedom - 1.0
    x, c = at[None, :], centre[:, None]
    product = c * x
    near = product < 1.0
    small = np.where(near, product, 0.0)
    large = np.where(near, 1.0, product)
    scale = freedom * 0.5
    log_front = -0.5 * (x - c) ** 2 - order * np.log(2.0) - special.gammaln(scale)
    log_near = np.log(special.hyp0f1(scale, 0.25 * small * small)) - small
    log_far = np.log(special.ive(order, large)) + special.gammaln(scale) - order * np.log(0.5 * large)
    return np.asarray(np.exp(log_front + np.where(near, log_near, log_far)))
