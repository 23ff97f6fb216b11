"""Charts of the measured values themselves, of all signals of a plant together, inputs too.

Here is what such charts share: the training, missing signals, the regression of each signal on all others, averages of
held-out rows, and the limit of averages whose variances were estimated.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import ClassVar, NamedTuple, Self

import numpy as np
from scipy import special

from reactorwatch.arrays import Array
from reactorwatch.spc.charts.base import ROWS_A_SIGNAL, Chart

FEWEST_SIGNALS = 8
"""Least number of signals of a chart of values: with fewer the others say too little of each one."""

BLOCKS = 5
"""Blocks of the cross-validation."""

SHRINKAGE = 0.01
"""Share by which correlations are reduced: without it, signals that follow from others have no inverse."""

NAMED = 3
"""Signals that the text of an alarm names."""


class ValueBaseline(NamedTuple):
    """A training as charts of values are designed from it.

    Attributes:
        names: names of the signals.
        values: rows in which no signal is missing, shape (rows, signals); each varies.
        arl0: run length of the alarm of a single signal without a fault, in rows.
        settings: settings of the charts, by key.
        signals: signals that the settings name for charts, by key.
    """

    names: tuple[str, ...]
    values: Array
    arl0: float
    settings: Mapping[str, float]
    signals: Mapping[str, tuple[str, ...]] = MappingProxyType({})


class ValueChart(Chart):
    """A chart of the values of all signals; a sample is a vector.

    It has the false alarms of one alarm for each of its signals.

    Attributes:
        names: names of its signals, in the order of a sample.
        locates: whether the first signals of its explanation are those at which a disturbance may enter.
        fewest_signals: least number of its signals.
    """

    names: tuple[str, ...]
    locates: ClassVar[bool] = False
    fewest_signals: ClassVar[int] = FEWEST_SIGNALS

    @classmethod
    @abstractmethod
    def design(cls, baseline: ValueBaseline) -> Self:
        """The chart for a training; there must be no obstacle to it."""

    @classmethod
    @abstractmethod
    def relative_rates(cls, baseline: ValueBaseline) -> Array:
        """Rate of false alarms by the errors of the training, in shares of one signal's alarm, shape (draws,)."""

    @abstractmethod
    def fill(self, x: Array) -> Array | None:
        """The sample with expected values in place of missing ones, NaN; None if too many are missing."""

    @abstractmethod
    def explain(self) -> tuple[str, dict[str, float]]:
        """The text of an alarm at the newest sample, and each signal's share of it, the largest first."""

    @classmethod
    def obstacle(cls, values: Array, names: Sequence[str], signals: Mapping[str, tuple[str, ...]]) -> str:
        """The reason why there can be no chart after a training; empty if there can.

        Args:
            values: rows in which no signal is missing, shape (rows, signals); each varies.
            names: names of the signals.
            signals: see `ValueBaseline`.
        """
        for item in cls.settings:
            lost = [name for name in signals.get(item.key, ()) if name not in names]
            if lost:
                return f"{item.key} names {lost[0]}, which does not vary in the training or has no values there"
        if len(names) < cls.fewest_signals:
            return f"it needs {cls.fewest_signals} signals or more that vary, got {len(names)}"
        needed = max(ROWS_A_SIGNAL * len(names), 100)  # of which a part is held out
        if len(values) < needed:
            return (
                f"the training has {len(values)} rows in which all {len(names)} signals could be learned from, "
                f"{needed} are needed"
            )
        return ""


def student_limit(baseline: ValueBaseline, known: float, freedom: float, largest: float) -> float:
    """Limit of averages whose variances were estimated, in standard deviations.

    Where less than one false alarm is promised in the rows of the training, it is not below their largest average.

    Args:
        baseline: training of the signals.
        known: limit that holds when the variances are known.
        freedom: degrees of freedom of the variances.
        largest: largest average of the training.
    """
    limit = -float(special.stdtrit(freedom, float(special.ndtr(-known))))
    return max(limit, largest) if baseline.values.size < baseline.arl0 else limit


def fill_missing(x: Array, centre: Array, matrix: Array) -> Array | None:
    """The sample with the mean given the others in place of missing signals; None if too many are missing.

    Args:
        x: values of the signals, shape (p,); NaN where missing.
        centre: mean of each signal, shape (p,).
        matrix: matrix from deviations of the signals to residuals, each in any unit, shape (p, p).
    """
    missing = ~np.isfinite(x)
    count = int(np.count_nonzero(missing))
    if not count:
        return x
    if count > 0.5 * x.size:
        return None
    off = np.where(missing, 0.0, x - centre)
    off[missing] = -np.linalg.solve(matrix[np.ix_(missing, missing)], matrix[missing] @ off)
    return np.asarray(np.where(missing, centre + off, x))


def adjustment(rows: Array) -> tuple[Array, Array]:
    """Means of signals, and the matrix from their deviations to the residuals w.

    Args:
        rows: scaled signals, shape (rows, p).
    """
    centre = rows.mean(axis=0)
    covariance = np.atleast_2d(np.cov(rows, rowvar=False))
    covariance *= 1.0 - SHRINKAGE
    covariance[np.diag_indices_from(covariance)] /= 1.0 - SHRINKAGE
    inverse = np.linalg.inv(covariance)
    return np.asarray(centre), np.asarray(inverse / np.sqrt(np.diag(inverse))[:, None])


def average_rows(residuals: Array, weight: float) -> Array:
    """Exponentially weighted averages of residuals from 0 on, without the first ones, shape (rows, p).

    Args:
        residuals: held-out residuals, shape (rows, p).
        weight: lambda.
    """
    averages, average = np.empty_like(residuals), np.zeros(residuals.shape[1])
    for row, residual in enumerate(residuals):
        average = average + weight * (residual - average)
        averages[row] = average
    return averages[min(int(2.0 / weight), len(averages) // 2) :]
