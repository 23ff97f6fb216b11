"""The residual space of many signals: how far each one is from what all others say in the same row.

With the scaled signals x of a row and their covariance S, the residual of signal i, given all others, is

    w_i = (S^-1 x)_i / sqrt((S^-1)_ii)

(Hawkins 1991, Multivariate quality control based on regression-adjusted variables, Technometrics 33). The inverse
weighs the directions that vary least, which are the residual space of PCA; signals of a controlled plant fill it, and a
fault leaves it. The chart takes the exponentially weighted average of each w_i in units of its standard deviation, and
its statistic is the largest of them in size. Its square is the reconstruction-based contribution of Alcala & Qin
(2009), Reconstruction-based contribution for process monitoring, Automatica 45: the signal with the largest one is the
likeliest entry of a disturbance.

Neither S nor the averages' standard deviations are known. In-sample residuals are too small where signals are many, and
the signals of a plant remember for hundreds of rows. So the training is cut into blocks, each is judged by the
covariance of the others, and the averages of these residuals give

- the ratio v_i of their mean square to that of white noise, at least 1: autocorrelation, errors of S and of the means
  are in it;
- the degrees of freedom of v_i, from the autocorrelation of the averages: n / (1 + 2 sum r_k^2) with n rows (Bartlett
  1946), the r_k averaged over the signals;
- a prior of the true ratios, from the spread of the v_i (Smyth 2004, Linear models and empirical Bayes methods,
  Statist. Appl. Genet. Mol. Biol. 3), which moderates each and adds degrees of freedom.

The limit is that of an EWMA of known variance for the run length of one signal's alarm, at the same tail of Student's
distribution with the degrees of freedom. Where less than one false alarm is promised in the rows of the training, it is
not below the largest of their averages.
"""

from collections.abc import Sequence
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from reactorwatch.arrays import Array, block_bounds
from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.errors import InputError, positive
from reactorwatch.spc.averages import independent_rows
from reactorwatch.spc.charts.base import LARGEST_VALUE, Judgement, Setting, vector
from reactorwatch.spc.charts.ewma import ewma_limit
from reactorwatch.spc.charts.value_chart import (
    ValueBaseline,
    ValueChart,
    adjustment,
    average_rows,
    fill_missing,
    student_limit,
)
from reactorwatch.spc.false_alarm_budget import TrainingErrors, student_tail
from reactorwatch.stored_state import Memory


@jit
def move(numbers: Array, x: Array, weight: float) -> float:
    """Take a row into the averages; returns the largest one in size, -1 if the row cannot be taken.

    Args:
        numbers: see `ResidualSpaceMemory`.
        x: shape (p,).
        weight: lambda.
    """
    for value in x:
        if not abs(value) < LARGEST_VALUE:
            return -1.0
    p, largest = x.size, 0.0
    for i in range(p):
        residual = 0.0
        for j in range(p):
            residual += numbers[1 + 2 * p + i * p + j] * (x[j] - numbers[1 + j])
        average = (1.0 - weight) * numbers[1 + p + i] + weight * residual
        numbers[1 + p + i] = average
        largest = max(largest, abs(average))
    return float(largest)


_MOVE = Entry(move)


class ResidualSpaceMemory(Memory):
    """Memory of the chart.

    Attributes:
        names: names of the signals.
        weight: lambda.
        numbers: limit, centre, averages and matrix, as `move` takes them.
    """

    names: tuple[str, ...]
    weight: float
    numbers: Array


class ResidualSpace(ValueChart):
    """The largest average residual of a signal, given all others.

    >>> chart = ResidualSpace(["a", "b"], [0.0, 0.0], [[1.0, -0.9], [-0.9, 1.0]], weight=0.5, limit=1.0)
    >>> [chart.update(x).out for x in ([3.0, 3.0], [3.0, 0.0])]
    [False, True]

    Args:
        names: names of the signals.
        centre: mean of each signal, shape (p,).
        matrix: matrix from deviations of the signals to residuals whose averages have the standard deviation 1, shape
            (p, p).
        weight: lambda, of the newest row, in (0, 1].
        limit: limit of the averages.

    Raises:
        InputError: an argument is out of its range, or the shapes differ.
    """

    name = "residual_space"
    locates = True
    memory_type = ResidualSpaceMemory
    settings = (Setting("residual_space_weight", 0.1, 0.01, 1.0),)

    def __init__(self, names: Sequence[str], centre: ArrayLike, matrix: ArrayLike, weight: float, limit: float) -> None:
        if not 0.0 < weight <= 1.0:
            raise InputError(f"weight (lambda) must be in (0, 1], got {weight}")
        p, middle, given = len(names), np.asarray(centre, np.float64), np.asarray(matrix, np.float64)
        if middle.shape != (p,) or given.shape != (p, p) or not np.all(np.isfinite(given)):
            raise InputError(f"centre and matrix must have {p} finite rows, got {middle.shape} and {given.shape}")
        numbers = np.concatenate([[positive("limit", limit)], middle, np.zeros(p), given.ravel()])
        self._use(ResidualSpaceMemory(tuple(names), float(weight), numbers))

    def _use(self, memory: ResidualSpaceMemory) -> None:
        """See `Chart`."""
        self.memory, self.names, self.weight, numbers = memory, memory.names, memory.weight, memory.numbers
        p = len(self.names)
        if numbers.size != 1 + 2 * p + p * p or not np.all(np.isfinite(numbers)):
            raise ValueError(f"numbers of {p} signals must be {1 + 2 * p + p * p} finite ones, got {numbers.tolist()}")
        self.limit = positive("limit", float(numbers[0]))
        self._centre, self._averages = numbers[1 : 1 + p], numbers[1 + p : 1 + 2 * p]
        self._matrix = numbers[1 + 2 * p :].reshape(p, p)

    @classmethod
    def design(cls, baseline: ValueBaseline) -> Self:
        """See `ValueChart`; `residual_space_weight` is the weight of the newest row."""
        scale = baseline.values.std(axis=0, ddof=1)
        scaled, weight = baseline.values / scale, baseline.settings["residual_space_weight"]
        sds, freedom, largest = held_out_deviations(scaled, weight)
        centre, matrix = adjustment(scaled)
        limit = student_limit(baseline, ewma_limit(baseline.arl0, weight), freedom, largest)
        return cls(baseline.names, centre * scale, matrix / sds[:, None] / scale, weight, limit)

    @classmethod
    def relative_rates(cls, baseline: ValueBaseline) -> Array:
        """See `ValueChart`: an average whose variance is off crosses the limit more or less often."""
        scale, weight = baseline.values.std(axis=0, ddof=1), baseline.settings["residual_space_weight"]
        _, freedom, largest = held_out_deviations(baseline.values / scale, weight)
        known = ewma_limit(baseline.arl0, weight)
        limit = student_limit(baseline, known, freedom, largest)
        errors = TrainingErrors.draw(len(baseline.names)).scale
        return np.asarray(np.sum(student_tail(limit, freedom, errors), axis=1) / special.ndtr(-known))

    def update(self, x: ArrayLike) -> Judgement:
        """See `Chart`; x has shape (p,)."""
        values = np.ascontiguousarray(x, dtype=np.float64)
        statistic = (
            _MOVE.call(self.memory.numbers, values, self.weight) if values.shape == self._averages.shape else -1.0
        )
        if statistic < 0.0:
            vector(x, self._averages.size)  # says what is wrong
        return Judgement(statistic, 0.0, 0.0, self.limit, statistic > self.limit)

    def fill(self, x: Array) -> Array | None:
        """See `ValueChart`: a missing signal gets its mean given the others, so its residual is 0."""
        return fill_missing(x, self._centre, self._matrix)

    def explain(self) -> tuple[str, dict[str, float]]:
        """See `ValueChart`: shares of the squared averages."""
        squares = self._averages**2
        order = np.argsort(-squares, kind="stable").tolist()
        parts = [f"{self.names[i]} ({self._averages[i]:+.1f} sd)" for i in order[:3]]
        text = (
            f"the disturbance enters at {self.names[order[0]]}: on average {parts[0]} is unlike what the other signals "
            f"say (allowed: {self.limit:.1f} sd)"
        )
        if parts[1:]:
            text += f"; next {' and '.join(parts[1:])}"
        return text, {self.names[i]: float(squares[i] / squares.sum()) for i in order}

    def restart(self) -> None:
        """Forget the rows seen."""
        self._averages[:] = 0.0


def held_out_residuals(rows: Array) -> Array:
    """Residuals of each block of a training by the covariance of the other blocks, shape (rows, p).

    Args:
        rows: scaled signals, shape (rows, p).
    """
    residuals = np.empty_like(rows)
    for first, end in block_bounds(len(rows)):
        centre, matrix = adjustment(np.concatenate([rows[:first], rows[end:]]))
        residuals[first:end] = (rows[first:end] - centre) @ matrix.T
    return residuals


def held_out_deviations(scaled: Array, weight: float) -> tuple[Array, float, float]:
    """Standard deviations of the averages, shape (p,), their degrees of freedom, and the largest average in them.

    Args:
        scaled: scaled signals, shape (rows, p).
        weight: lambda.
    """
    residuals = held_out_residuals(scaled)
    averages = average_rows(residuals, weight)
    white = np.mean(residuals**2, axis=0) * weight / (2.0 - weight)
    lags = min(int(10.0 / weight), len(averages) // 2)  # up to ten memories of an average
    ratios, freedom = moderate(np.mean(averages**2, axis=0) / white, independent_rows(averages, lags))
    sds = np.sqrt(white * np.maximum(ratios, 1.0))
    return sds, freedom, float(np.max(np.abs(averages) / sds))


def moderate(ratios: Array, freedom: float) -> tuple[Array, float]:
    """Ratios moderated by their common prior, shape (p,), and their degrees of freedom with those of the prior.

    The logarithm of a mean square with d degrees of freedom has the variance trigamma(d / 2); what it varies more over
    the signals is that of the true ratios, whose prior is an inverse chi-square.

    Args:
        ratios: mean squares, shape (p,).
        freedom: degrees of freedom of each.
    """
    from scipy import optimize  # takes a fifth of a second, which a monitor's start does not need

    logs = np.log(ratios) - special.digamma(freedom / 2) + np.log(freedom / 2)
    excess = float(np.var(logs, ddof=1)) - float(special.polygamma(1, freedom / 2))
    prior = (ratios.size - 1) * freedom  # of the other signals' mean squares, if all true ratios are equal
    if excess > float(special.polygamma(1, prior / 2)):
        prior = 2.0 * float(optimize.brentq(lambda x: float(special.polygamma(1, x)) - excess, 1e-3, prior / 2))
    centre = float(np.exp(logs.mean() + special.digamma(prior / 2) - np.log(prior / 2)))
    return np.asarray((prior * centre + freedom * ratios) / (prior + freedom)), prior + freedom
