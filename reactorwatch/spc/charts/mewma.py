"""The multivariate exponentially weighted moving average: sees small changes of several signals at once.

Lowry, Woodall, Champ & Rigdon (1992), A multivariate exponentially weighted moving average control chart,
Technometrics 34(1). With d = x - mean, S the covariance of x and lambda the weight of the newest vector

    z <- (1 - lambda) z + lambda d,      out: z' Sz^-1 z > limit,      Sz = lambda / (2 - lambda) S,

where Sz is the covariance of z in the long run. z is kept in coordinates in which S is the unit matrix.

The run length is reduced from p to two dimensions. Runger & Prabhu (1996), A Markov chain model for the multivariate
exponentially weighted moving averages control chart, J. Amer. Statist. Assoc. 91; as an integral equation Rigdon
(1995), Statist. Probab. Letters 24. In coordinates in which the covariance is the unit matrix and the shift lies along
the first axis, the average z has a part a along the shift and a part of length r across it; what direction r has does
not matter. The chart has not signalled while a^2 + r^2 <= R^2 = limit lambda / (2 - lambda). In units of lambda the
next a is normal about the present one,

    a' / lambda ~ N((1 - lambda) a / lambda + shift, 1),

and the next r, independent of it, chi with p - 1 degrees of freedom, non-central by (1 - lambda) r / lambda.

Their product is the kernel of an integral equation over half a disc. Where Runger & Prabhu cut the half disc into
cells, it is solved here at Gauss nodes: in a with the weight (R^2 - a^2)^((p-1)/2) and for each a in r^2 with the
weight r^(p-2), which are the volumes that a and r stand for. The remainder is smooth in a and r^2, so some hundred
nodes give five digits. (The Markov chain is kept in the tests, as the independent second method.) Without a shift only
|z| matters, chi with p degrees of freedom, and the equation has one dimension.
"""

from functools import cache
from math import ceil, sqrt
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.charts.base import (
    LARGEST_VALUE,
    MOST_SIGNALS,
    Baseline,
    Design,
    JointChart,
    Judgement,
    Setting,
    correlation,
    vector,
)
from reactorwatch.spc.charts.ewma import ewma_run_length
from reactorwatch.spc.charts.t2 import Whitening, joint_limit, joint_rates, t2_run_length
from reactorwatch.spc.false_alarm_budget import TrainingErrors
from reactorwatch.spc.prewhitening import memory_covariance
from reactorwatch.spc.run_length import (
    MOST_SHIFTED_SIGNALS,
    check_length,
    check_range,
    fastest_parameter,
    limit_for,
    run_lengths,
    shift_size,
    stationary_distribution,
)
from reactorwatch.stored_state import Memory

SMALLEST_WEIGHT_WITHOUT_SHIFT = 1e-4
"""Smallest weight whose run length is computed: without a shift there is one dimension, with far fewer nodes."""

LARGEST_LIMIT = 200.0
"""Largest limit whose run length after a shift is computed: the nodes of its two dimensions grow with it."""


@jit
def move(numbers: Array, x: Array, weight: float) -> float:
    """Take x into the average, in white coordinates; returns the statistic, -1 if x cannot be taken.

    Args:
        numbers: numbers of the chart, see `MewmaMemory`.
        x: shape (p,).
        weight: lambda.
    """
    for value in x:
        if not abs(value) < LARGEST_VALUE:
            return -1.0
    p, squares = x.size, 0.0
    for i in range(p):
        white = 0.0
        for j in range(i + 1):  # the matrix is lower triangular
            white += numbers[1 + 2 * p + i * p + j] * (x[j] - numbers[1 + j])
        average = (1.0 - weight) * numbers[1 + p + i] + weight * white
        numbers[1 + p + i] = average
        squares += average * average
    return squares * (2.0 - weight) / weight


_MOVE = Entry(move)


class MewmaMemory(Memory):
    """Memory of a MEWMA chart.

    Attributes:
        weight: lambda.
        numbers: limit, mean, average in white coordinates, whitening matrix, as `move` takes them, and covariance.
    """

    weight: float
    numbers: Array


class Mewma(JointChart):
    """The moving average of vectors, its distance from the mean measured by its covariance.

    >>> chart = Mewma([0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]], weight=0.1, limit=8.64)
    >>> [chart.update([2.0, 0.0]).out for _ in range(4)]
    [False, False, False, True]

    Args:
        mean: mean of the vectors when all is well, shape (p,).
        covariance: covariance of the vectors, shape (p, p).
        weight: lambda, of the newest vector, in (0, 1]; small for small changes.
        limit: limit H of z' Sz^-1 z.

    Raises:
        InputError: an argument out of its range, or covariance not a symmetric positive definite matrix of that size.
    """

    name = "mewma"
    memory_type = MewmaMemory
    settings = (Setting("mewma_weight", 0.02, 0.01, 1.0),)

    def __init__(self, mean: ArrayLike, covariance: ArrayLike, weight: float, limit: float) -> None:
        if not 0.0 < weight <= 1.0:
            raise InputError(f"weight (lambda) must be in (0, 1], got {weight}")
        given, p = Whitening(mean, covariance), np.size(mean)
        numbers = [
            np.array([positive("limit", limit)]),
            given.mean,
            np.zeros(p),
            given.matrix.ravel(),
            given.covariance.ravel(),
        ]
        self._use(MewmaMemory(float(weight), np.concatenate(numbers)))

    def _use(self, memory: MewmaMemory) -> None:
        """See `Chart`."""
        self.memory, self.weight, numbers = memory, memory.weight, memory.numbers
        if not np.all(np.isfinite(numbers)):
            raise ValueError(f"numbers of the chart must be finite, got {numbers.tolist()}")
        p = round(0.5 * (sqrt(2.0 * numbers.size - 1.0) - 1.0)) if numbers.size else 0
        if p < 1 or count_numbers(p) != numbers.size:
            raise ValueError(f"there must be as many numbers as a chart has, got {numbers.size}")
        self.limit, self._average = positive("limit", float(numbers[0])), numbers[1 + p : 1 + 2 * p]
        self.whitening = Whitening(numbers[1 : 1 + p], numbers[1 + 2 * p + p * p :].reshape(p, p))

    @classmethod
    def fastest(cls, arl0: float, shift: float, dimension: int, rules: tuple[int, ...]) -> Design:
        """See `Chart`."""
        weight = fastest_parameter(
            lambda w: mewma_run_length(shift, dimension, w, mewma_limit(arl0, dimension, w)),
            max(0.01, min(0.03 * shift**1.4, 0.2)),  # smaller ones need too many nodes in two dimensions
            min(0.4 * shift**1.4, 1.0),
            accuracy=0.03,
        )
        limit = mewma_limit(arl0, dimension, weight)
        parameters = {"dimension": dimension, "lambda": weight, "limit": limit}
        return Design(cls.name, parameters, arl0, shift, mewma_run_length(shift, dimension, weight, limit))

    @classmethod
    def design(cls, baseline: Baseline) -> Self:
        """See `JointChart`; `mewma_weight` is the weight of the newest row."""
        weight, sd = baseline.settings["mewma_weight"], np.array(baseline.memory_sd)
        known = mewma_limit(baseline.arl0, sd.size, weight)
        limit = joint_limit(known, weight, baseline.learned, len(baseline.e))
        independent = correlation(baseline.e) * np.outer(sd, sd)
        return cls(np.zeros(sd.size), memory_covariance(baseline.e, independent, weight), weight, limit)

    @classmethod
    def relative_rates(cls, baseline: Baseline, errors: TrainingErrors) -> Array:
        """See `JointChart`."""
        weight = baseline.settings["mewma_weight"]
        return joint_rates(mewma_limit(baseline.arl0, len(baseline.learned), weight), weight, baseline, errors)

    @classmethod
    def detector(cls, baseline: Baseline) -> tuple[float, float, Array] | None:
        """See `Chart`."""
        chart = cls.design(baseline)
        return chart.weight, sqrt(chart.limit), chart.whitening.matrix

    def update(self, x: ArrayLike) -> Judgement:
        """See `Chart`; x has shape (p,)."""
        values = np.ascontiguousarray(x, dtype=np.float64)
        statistic = (
            _MOVE.call(self.memory.numbers, values, self.weight) if values.shape == self._average.shape else -1.0
        )
        if statistic < 0.0:
            vector(x, self._average.size)  # says what is wrong
        return Judgement(statistic, float(self._average.size), 0.0, self.limit, statistic > self.limit)

    def contributions(self, x: ArrayLike | None = None) -> Array:
        """Each signal's part of the statistic, shape (p,); their sum is the statistic, one may be negative.

        The partial decomposition, as for `T2.contributions`, of the average instead of the newest vector x.
        """
        matrix = self.whitening.matrix
        off = np.linalg.solve(matrix, self._average)
        return np.asarray(off * (matrix.T @ self._average) * (2.0 - self.weight) / self.weight)

    def restart(self) -> None:
        """Forget the vectors seen."""
        self._average[:] = 0.0


def count_numbers(signals: int) -> int:
    """Count of a chart's numbers."""
    return 1 + 2 * signals + 2 * signals * signals


@cache
def mewma_limit(arl0: float, dimension: int, weight: float) -> float:
    """Limit H of the MEWMA of weight lambda for an in-control run length."""
    step = max(2.0, 0.5 * dimension)
    return limit_for(arl0, lambda limit: mewma_run_length(0.0, dimension, weight, limit), step, 500.0)


def mewma_run_length(shift: float, dimension: int, weight: float, limit: float, *, steady_state: bool = False) -> float:
    """Average run length of a MEWMA.

    >>> round(mewma_run_length(1.0, dimension=2, weight=0.1, limit=8.64), 1)
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
    check_range("dimension", dimension, 1, MOST_SHIFTED_SIGNALS if size > 0.0 else MOST_SIGNALS)
    check_range("weight (lambda)", weight, 0.01 if size > 0.0 else SMALLEST_WEIGHT_WITHOUT_SHIFT, 1.0)
    check_range("limit", positive("limit", limit), 1e-6, LARGEST_LIMIT if size > 0.0 else 500.0)
    if weight == 1.0:
        return t2_run_length(size, dimension, limit)
    # The radius in units of lambda, in which each step has unit variance.
    radius = sqrt(limit / (weight * (2.0 - weight)))
    rest = 1.0 - weight
    if size == 0.0:
        return _without_shift(dimension, rest, radius, steady_state=steady_state)
    if dimension == 1:
        return ewma_run_length(size, weight, sqrt(limit), steady_state=steady_state)
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
