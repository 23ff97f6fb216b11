"""The training of a plant as charts are designed from it, with the false alarms that they may raise."""

from collections.abc import Mapping, Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.spc.prewhitening import Prewhitening


class Baseline(NamedTuple):
    """A training of one or several signals, and how rarely a chart of them may raise a false alarm.

    Attributes:
        learned: the prewhitening of each signal.
        e: prewhitened residuals, shape (rows, signals), of the rows in which no signal is missing.
        memory_sd: standard deviation of each signal that charts with a memory use, see `memory_sds`.
        arl0: run length of the alarm without a fault, in rows.
        point_probability: probability of a single point that is out, of a chart whose alarm takes several points.
        settings: settings of the charts, by key.
    """

    learned: tuple[Prewhitening, ...]
    e: Array
    memory_sd: tuple[float, ...]
    arl0: float
    point_probability: float
    settings: Mapping[str, float]

    def of(self, signals: Sequence[int]) -> "Baseline":
        """The baseline of some of the signals, by their indices."""
        return self._replace(
            learned=tuple(self.learned[index] for index in signals),
            e=complete_rows(self.e, signals),
            memory_sd=tuple(self.memory_sd[index] for index in signals),
        )


def complete_rows(e: Array, signals: Sequence[int]) -> Array:
    """The rows in which none of these signals is missing, shape (rows, len(signals))."""
    e = e[:, list(signals)]
    return e[np.all(np.isfinite(e), axis=1)]


def memory_sds(e: Array, weight: float) -> tuple[float, ...]:
    """Standard deviation of each signal that charts with a memory use; 1 if its residual is white.

    An autoregression of few coefficients may miss a correlation over many rows. It shows in averages: theirs should
    have the variance weight / (2 - weight). Where it is larger by more than chance allows, limits follow it.

    Args:
        e: prewhitened residuals, shape (rows, signals); NaN where there is none.
        weight: weight of the newest row in the averages.
    """
    sds = []
    for column in e.T:
        column = column[np.isfinite(column)]
        average, squares = 0.0, 0.0
        for value in column.tolist():
            average += weight * (value - average)
            squares += average * average
        ratio = squares / max(len(column), 1) * (2.0 - weight) / weight
        independent = max(len(column) * weight / 2.0, 1.0)
        sds.append(sqrt(ratio) if ratio > 1.0 + 3.0 * sqrt(2.0 / independent) else 1.0)
    return tuple(sds)
