"""Hotelling's T2: the Shewhart chart of several signals at once.

Hotelling (1947), Multivariate quality control. Signals that move together can each be within their limits while the
pair of them is impossible. With d = x - mean and S the covariance, both known,

    T2 = d' S^-1 d,      out: T2 > limit;

T2 of independent normal vectors is chi-square with as many degrees of freedom as there are signals.
"""

from math import sqrt
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.errors import InputError, positive
from reactorwatch.spc.baseline import Baseline
from reactorwatch.spc.charts.base import Array, Judgement, vector
from reactorwatch.spc.joint_chart import JointChart, correlation, joint_limit
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
    def design(cls, baseline: Baseline) -> Self:
        """See `JointChart`."""
        limit = joint_limit(1.0 / baseline.point_probability, 1.0, baseline.learned, len(baseline.e))
        return cls(np.zeros(len(baseline.learned)), correlation(baseline.e), limit)

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
