"""Hotelling's T2: the Shewhart chart of several signals at once.

Hotelling (1947), Multivariate quality control. Signals that move together can each be within their limits while the
pair of them is impossible. With d = x - mean and S the covariance, both known,

    T2 = d' S^-1 d,      out: T2 > limit;

T2 of independent normal vectors is chi-square with as many degrees of freedom as there are signals, after a shift of
the mean non-central by the square of its Mahalanobis distance, and the run length is geometric.

With the true covariance that is the limit. Two errors of a training widen it, of this chart and of a MEWMA:

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

from collections.abc import Sequence
from functools import lru_cache
from math import inf, log, sqrt
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.charts.base import MOST_SIGNALS, Baseline, Design, JointChart, Judgement, correlation, vector
from reactorwatch.spc.false_alarm_budget import DRAWS, SEED, TrainingErrors, degrees_of_freedom
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.run_length import check_length, check_range, limit_for, shift_size
from reactorwatch.stored_state import Memory


class T2Memory(Memory):
    """Memory of a T2 chart: the arguments of `T2`."""

    mean: Array
    covariance: Array
    limit: float


class T2(JointChart):
    """A vector's distance from its mean, measured by its covariance.

    >>> chart = T2([0.0, 0.0], [[1.0, 0.9], [0.9, 1.0]], limit=10.597)
    >>> chart.update([2.0, 2.0]).out, chart.update([2.0, -2.0]).out
    (False, True)

    Args:
        mean: mean of the vectors when all is well, shape (p,).
        covariance: covariance of the vectors, shape (p, p).
        limit: limit of T2.

    Raises:
        InputError: limit is not a positive number, or covariance not a symmetric positive definite matrix of that size.
    """

    name = "t2"
    memory_type = T2Memory
    has_memory = False

    def __init__(self, mean: ArrayLike, covariance: ArrayLike, limit: float) -> None:
        self._use(T2Memory(np.array(mean, dtype=np.float64), np.array(covariance, dtype=np.float64), limit))

    def _use(self, memory: T2Memory) -> None:
        """See `Chart`."""
        self.memory, self.whitening = memory, Whitening(memory.mean, memory.covariance)
        self.limit = positive("limit", memory.limit)

    @classmethod
    def fastest(cls, arl0: float, shift: float, dimension: int, rules: tuple[int, ...]) -> Design:
        """See `Chart`: it has no memory, so only its limit."""
        limit = float(special.chdtri(dimension, 1.0 / arl0))
        parameters = {"dimension": dimension, "limit": limit}
        return Design(cls.name, parameters, arl0, shift, t2_run_length(shift, dimension, limit))

    @classmethod
    def design(cls, baseline: Baseline) -> Self:
        """See `JointChart`."""
        known = t2_limit(1.0 / baseline.point_probability, len(baseline.learned))
        limit = joint_limit(known, 1.0, baseline.learned, len(baseline.e))
        return cls(np.zeros(len(baseline.learned)), correlation(baseline.e), limit)

    @classmethod
    def relative_rates(cls, baseline: Baseline, errors: TrainingErrors) -> Array:
        """See `JointChart`."""
        return joint_rates(t2_limit(1.0 / baseline.point_probability, len(baseline.learned)), 1.0, baseline, errors)

    @classmethod
    def detector(cls, baseline: Baseline) -> tuple[float, float, Array] | None:
        """See `Chart`."""
        chart = cls.design(baseline)
        return 1.0, sqrt(chart.limit), chart.whitening.matrix

    def update(self, x: ArrayLike) -> Judgement:
        """See `Chart`; x has shape (p,)."""
        white = self.whitening.of(x)
        statistic = float(white @ white)
        return Judgement(statistic, float(white.size), 0.0, self.limit, statistic > self.limit)

    def restart(self) -> None:
        """Do nothing: there is no memory."""

    def contributions(self, x: ArrayLike) -> Array:
        """Each signal's part of T2, shape (p,): d_j (S^-1 d)_j. Their sum is T2; one may be negative.

        The partial decomposition of Alcala & Qin (2011), Analysis and generalization of fault diagnosis methods for
        process monitoring, J. Process Control 21(3).
        """
        return self.whitening.contributions(x)


class Whitening:
    """The map that makes vectors of known mean and covariance into uncorrelated ones of unit variance.

    Args:
        mean: shape (p,).
        covariance: shape (p, p).

    Raises:
        InputError: covariance is not a symmetric positive definite matrix of the size of the mean.
    """

    def __init__(self, mean: ArrayLike, covariance: ArrayLike) -> None:
        self.mean: Array = np.array(mean, dtype=np.float64)
        self.covariance: Array = np.array(covariance, dtype=np.float64)
        p = self.mean.size
        if self.mean.shape != (p,) or p < 1 or not np.all(np.isfinite(self.mean)):
            raise InputError(f"mean must be a vector of finite numbers, got {self.mean.tolist()}")
        if self.covariance.shape != (p, p):
            raise InputError(f"covariance must have shape ({p}, {p}) as the mean has {p}, got {self.covariance.shape}")
        if not np.array_equal(self.covariance, self.covariance.T):
            raise InputError(f"covariance must be symmetric, got {self.covariance.tolist()}")
        try:
            root = np.linalg.cholesky(self.covariance)
        except np.linalg.LinAlgError:
            raise InputError(f"covariance must be positive definite, got {self.covariance.tolist()}") from None
        self.matrix: Array = np.linalg.inv(root)

    def of(self, x: ArrayLike) -> Array:
        """The white vector, shape (p,).

        Raises:
            ValueError: x has not the shape (p,), or is not finite.
        """
        return np.asarray(self.matrix @ (vector(x, self.mean.size) - self.mean))

    def contributions(self, x: ArrayLike) -> Array:
        """Each entry's part of the white vector's squared length, shape (p,)."""
        return np.asarray((vector(x, self.mean.size) - self.mean) * (self.matrix.T @ self.of(x)))


def t2_run_length(shift: float, dimension: int, limit: float) -> float:
    """Average run length of T2 with known covariance, the same for zero and steady state.

    >>> round(t2_run_length(1.0, 2, 10.597), 2)
    41.92

    Args:
        shift: Mahalanobis distance of the shift of the mean.
        dimension: number of signals, p, at most 100.
        limit: limit of T2.

    Raises:
        InputError: an argument out of its range.
    """
    positive("limit", limit)
    check_range("dimension", dimension, 1, MOST_SIGNALS)
    size = shift_size(shift)
    if size == 0.0:
        return check_length(1.0 / max(float(special.chdtrc(dimension, limit)), 1e-300))
    from scipy import stats  # takes longer to import than all else here to compute

    return check_length(1.0 / max(float(stats.ncx2.sf(limit, dimension, size * size)), 1e-300))


def t2_limit(arl0: float, dimension: int) -> float:
    """Limit of T2 for an in-control run length."""
    return limit_for(arl0, lambda limit: t2_run_length(0.0, dimension, limit), max(2.0, 0.5 * dimension), 500.0)


# --- limits and rates after a training ---------------------------------------------------------------------------


def joint_limit(known: float, weight: float, learned: Sequence[Prewhitening], rows: float) -> float:
    """The limit of a MEWMA's, or with the weight 1 of a T2's, statistic after a training.

    Args:
        known: limit that holds when all is known.
        weight: lambda.
        learned: the training of each signal.
        rows: number of rows from which the correlations of the signals were estimated.
    """
    freedoms = tuple(degrees_of_freedom(item, weight) for item in learned)
    limit = estimated_t2_quantile(float(special.chdtrc(len(learned), known)), freedoms, rows)
    return limit * (1.0 + (2.0 - weight) / (weight * min(item.rows for item in learned)))


def joint_rates(known: float, weight: float, baseline: Baseline, errors: TrainingErrors) -> Array:
    """Rate of a MEWMA, or with the weight 1 of a T2, relative to the intended one, shape (draws,).

    Args:
        known: limit that holds when all is known.
        weight: lambda.
        baseline: training of the signals.
        errors: errors of these signals.
    """
    learned, rows, count = baseline.learned, len(baseline.e), len(baseline.learned)
    scale = np.column_stack([errors.true_scale(i, item, weight) for i, item in enumerate(learned)])
    factor = sqrt((2.0 - weight) / weight)
    mean = scale * errors.mean * factor / np.sqrt([float(item.rows) for item in learned])
    # Of more signals the limit has the errors of correlations on average.
    turned = _correlation_errors(count, rows) if count <= 8 else np.tile(np.eye(count), (DRAWS, 1, 1))
    covariance = scale[:, :, None] * turned * scale[:, None, :]
    sizes, directions = np.linalg.eigh(covariance)
    shifts = np.einsum("dij,di->dj", directions, mean) / np.sqrt(sizes)
    tail = weighted_chi2_tail(sizes, shifts**2, joint_limit(known, weight, learned, rows))
    return tail / float(special.chdtrc(count, known))


@lru_cache(maxsize=16)  # a chart's design and its rates need the same one
def estimated_t2_quantile(tail: float, freedoms: tuple[float, ...], rows: float) -> float:
    """Upper quantile of T2 when scales and correlations of its signals were estimated from a training.

    >>> round(estimated_t2_quantile(0.01, (20.0,), 20), 2)  # F(1, 20)
    8.1

    Args:
        tail: probability that T2 exceeds the quantile, above 1e-12.
        freedoms: degrees of freedom of the p scales, above 2.
        rows: n, number of rows from which the correlations were estimated; more than p + 1.

    Returns:
        The quantile; infinite beyond 1e7: a chart with such a limit detects nothing.
    """
    from scipy import optimize  # takes a fifth of a second, which a monitor's start does not need

    p = len(freedoms)
    factor, share = _factor(p, rows)
    reach = 4.0 * float(special.chdtri(p, tail))

    def beyond(x: float) -> float:
        return float(share @ np.exp(np.interp(np.minimum(x / factor, at[-1]), at, log_tail)))

    while reach < 1e7:
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
    log_chi2 = np.linspace(-9.0, 9.0, 121) * sqrt(2.0 / freedom)
    weight = np.exp(0.5 * freedom * (log_chi2 - np.exp(log_chi2) + 1.0))
    return mean * (freedom - 2.0) / freedom * np.exp(-log_chi2), weight / weight.sum()


def _sum_tail(freedoms: tuple[float, ...], reach: float) -> tuple[Array, Array]:
    """A grid up to `reach`, and the logarithm of the probability that the sum of F(1, nu_i) is beyond each point."""
    points = 2**13  # the step is about a thousandth of the quantile
    step = reach / points
    at: Array = step * np.arange(points + 2, dtype=np.float64)
    transform = np.ones(points + 1, dtype=np.complex128)
    for freedom, count in zip(*np.unique(np.minimum(freedoms, 1e6), return_counts=True), strict=True):
        # The mean excess over each point; its second differences are the masses that keep the mean.
        below = freedom / (at + freedom)
        excess = freedom / (freedom - 2.0) * special.betainc(0.5 * freedom - 1.0, 1.5, below)
        excess -= at * special.betainc(0.5 * freedom, 0.5, below)
        mass = np.diff(excess, 2, prepend=excess[0]) / step
        mass[0] += 1.0
        transform *= np.fft.rfft(mass, 2 * points) ** count
    mass = np.asarray(np.fft.irfft(transform, 2 * points)[:points], dtype=np.float64)
    # Below 1e-15 a tail is rounding of the transform.
    log_tail: Array = np.log(np.maximum(1.0 - (np.cumsum(mass) - 0.5 * mass), 1e-15))
    return at[:points], log_tail


def _correlation_errors(count: int, rows: float) -> Array:
    """True correlation matrices of signals that the training found uncorrelated, shape (draws, count, count)."""
    numbers = np.random.default_rng(SEED + 1).standard_normal((DRAWS, count, count)) / sqrt(rows)
    errors = np.tril(numbers, -1)
    matrix = errors + errors.transpose(0, 2, 1) + np.eye(count)
    sizes, directions = np.linalg.eigh(matrix)
    matrix = np.einsum("dij,dj,dkj->dik", directions, np.maximum(sizes, 0.05), directions)
    lengths = np.sqrt(np.einsum("dii->di", matrix))
    return np.asarray(matrix / (lengths[:, :, None] * lengths[:, None, :]))


def weighted_chi2_tail(weights: Array, noncentrality: Array, limit: float) -> Array:
    """Probability that a weighted sum of squares of normal numbers exceeds a limit, shape (sums,).

    By the saddlepoint (Lugannani & Rice 1980, Advances in Applied Probability 12; Kuonen 1999, Saddlepoint
    approximations for distributions of quadratic forms in normal variables, Biometrika 86); good to some percent of
    the probability itself, far out in the tail.

    >>> round(float(weighted_chi2_tail(np.ones((1, 2)), np.zeros((1, 2)), 30.0)[0] * np.exp(15.0)), 2)  # exactly 1
    1.03

    Args:
        weights: weights, shape (sums, terms), above 0.
        noncentrality: squares of the numbers' means, same shape.
        limit: the limit; where it is not above the mean of the sum the result is 1/2 to 1.
    """
    mean = np.sum(weights * (1.0 + noncentrality), axis=1)
    largest = weights.max(axis=1)
    low, high = np.zeros(len(weights)), (1.0 - 1e-12) / (2.0 * largest)
    for _ in range(40):  # bisection: K' increases from the mean to infinity
        t = 0.5 * (low + high)
        rest = 1.0 - 2.0 * weights * t[:, None]
        slope = np.sum(weights / rest + weights * noncentrality / rest**2, axis=1)
        low, high = np.where(slope < limit, t, low), np.where(slope < limit, high, t)
    t = np.maximum(0.5 * (low + high), 1e-9 / largest)
    rest = 1.0 - 2.0 * weights * t[:, None]
    K = np.sum(-0.5 * np.log(rest) + noncentrality * weights * t[:, None] / rest, axis=1)
    curvature = np.sum(2.0 * weights**2 / rest**2 + 4.0 * weights**2 * noncentrality / rest**3, axis=1)
    w = np.sqrt(np.maximum(2.0 * (t * limit - K), 1e-300))
    u = t * np.sqrt(curvature)
    tail = special.ndtr(-w) + np.exp(-0.5 * w * w) / np.sqrt(2.0 * np.pi) * (1.0 / u - 1.0 / w)
    return np.asarray(np.where(limit > mean * (1.0 + 1e-3), np.clip(tail, 0.0, 1.0), 0.5))
