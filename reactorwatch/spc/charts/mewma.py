"""The multivariate exponentially weighted moving average: sees small changes of several signals at once.

Lowry, Woodall, Champ & Rigdon (1992), A multivariate exponentially weighted moving average control chart,
Technometrics 34(1). With d = x - mean, S the covariance of x and lambda the weight of the newest vector

    z <- (1 - lambda) z + lambda d,      out: z' Sz^-1 z > limit,      Sz = lambda / (2 - lambda) S,

where Sz is the covariance of z in the long run. z is kept in coordinates in which S is the unit matrix.
"""

from math import sqrt
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.baseline import Baseline
from reactorwatch.spc.charts.base import LARGEST_VALUE, Array, Judgement, Setting, vector
from reactorwatch.spc.charts.t2 import Whitening
from reactorwatch.spc.joint_chart import JointChart, correlation, joint_limit, joint_rates
from reactorwatch.spc.training_errors import TrainingErrors
from reactorwatch.stored_state import Memory


@jit
def move(numbers: Array, x: Array, weight: float) -> float:
    """Take x into the average, in white coordinates; returns the statistic, -1 if x cannot be taken.

    Args:
        numbers: numbers of the chart, see `Mewma.numbers`.
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
        p = signals_of(numbers)
        self.limit, mean, self._average = (
            positive("limit", float(numbers[0])),
            numbers[1 : 1 + p],
            numbers[1 + p : 1 + 2 * p],
        )
        self.whitening = Whitening(mean, numbers[1 + 2 * p + p * p :].reshape(p, p))

    @property
    def numbers(self) -> Array:
        """Numbers of the chart, see `MewmaMemory`."""
        numbers: Array = self.memory.numbers
        return numbers

    @classmethod
    def design(cls, baseline: Baseline) -> Self:
        """See `JointChart`; `mewma_weight` is the weight of the newest row."""
        weight, sd = baseline.settings["mewma_weight"], np.array(baseline.memory_sd)
        limit = joint_limit(baseline.arl0, weight, baseline.learned, len(baseline.e))
        return cls(np.zeros(sd.size), correlation(baseline.e) * np.outer(sd, sd), weight, limit)

    @classmethod
    def relative_rates(cls, baseline: Baseline, errors: TrainingErrors) -> Array:
        """See `JointChart`."""
        return joint_rates(1.0 / baseline.arl0, baseline.settings["mewma_weight"], baseline, errors)

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


def signals_of(numbers: Array) -> int:
    """Number of signals of a chart with given numbers.

    Raises:
        ValueError: no chart has so many.
    """
    found = next((p for p in range(1, numbers.size) if count_numbers(p) == numbers.size), None)
    if found is None:
        raise ValueError(f"there must be as many numbers as a chart has, got {numbers.size}")
    return found
