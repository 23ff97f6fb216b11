"""Charts of all signals together: their limits, the reasons why there can be none, and what they say."""

from abc import abstractmethod
from collections.abc import Sequence
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from reactorwatch.spc.baseline import Baseline
from reactorwatch.spc.charts.base import Array, Chart, Shown
from reactorwatch.spc.estimated_t2 import estimated_t2_quantile
from reactorwatch.spc.false_alarm_budget import degrees_of_freedom
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.run_length.control_limits import mewma_limit
from reactorwatch.spc.run_length.mewma import LARGEST_DIMENSION_WITHOUT_SHIFT as LARGEST_DIMENSION
from reactorwatch.spc.training_errors import TrainingErrors, joint_relative_rate

ROWS_A_SIGNAL = 2
"""Rows of the training that a chart of all signals needs for each: with fewer their correlations are hardly known."""

LEAST_VARIANCE = 1e-8
"""Share of one signal's own variance that a combination of signals must have; with less it varies by rounding only."""


class JointChart(Chart):
    """A chart of all signals together; a sample is a vector."""

    @classmethod
    @abstractmethod
    def design(cls, baseline: Baseline) -> Self:
        """The chart for a training; there must be no obstacle to it."""

    @classmethod
    def relative_rates(cls, baseline: Baseline, errors: TrainingErrors) -> Array:
        """Rate of false alarms by the errors of the training, relative to the intended one, shape (draws,).

        Of a chart without memory it is that of its single points. A chart that does not define it counts as T2.

        Args:
            baseline: training of the signals, as for `design`.
            errors: errors of these signals.
        """
        return joint_rates(1.0 / baseline.arl0 if cls.has_memory else baseline.point_probability, 1.0, baseline, errors)

    @abstractmethod
    def contributions(self, x: ArrayLike) -> Array:
        """Each signal's part of the newest statistic, shape (p,); x is the newest sample."""

    @classmethod
    def obstacle(cls, e: Array, names: Sequence[str]) -> str:
        """The reason why there can be no chart after a training; empty if there can.

        Args:
            e: prewhitened residuals without missing ones, shape (rows, signals).
            names: names of the signals.
        """
        count = len(names)
        if count < 2:
            return "it needs two outputs or more"
        if count > LARGEST_DIMENSION:
            return f"it takes at most {LARGEST_DIMENSION} outputs, got {count}"
        if len(e) < ROWS_A_SIGNAL * count:
            return (
                f"the training has {len(e)} rows in which all {count} outputs could be learned from, "
                f"{ROWS_A_SIGNAL * count} are needed"
            )
        sizes, directions = np.linalg.eigh(correlation(e))
        if sizes[0] < LEAST_VARIANCE:
            alike = [names[index] for index in np.flatnonzero(np.abs(directions[:, 0]) > 0.1).tolist()]
            return f"one of the outputs {', '.join(alike)} follows from the others"
        return ""

    def explain(self, x: ArrayLike, signals: Sequence[Shown]) -> tuple[str, dict[str, float]]:
        """The text of an alarm, and each signal's share of it.

        Args:
            x: the newest sample, which is out.
            signals: signals of the sample, in order.
        """
        parts = np.maximum(self.contributions(x), 0.0)
        shares = parts / np.sum(parts)
        order = np.argsort(-shares)
        names = " and ".join(f"{signals[index].name} ({100 * shares[index]:.0f} %)" for index in order)
        text = f"what the model leaves unexplained is unlike the training: {names}"
        return text, {signals[index].name: float(shares[index]) for index in order}


def correlation(e: Array) -> Array:
    """Correlation matrix of the columns, shape (columns, columns); 0 with one that does not vary."""
    off = e - e.mean(axis=0) if len(e) else np.zeros((1, e.shape[1]))
    lengths = np.linalg.norm(off, axis=0)
    products = np.outer(lengths, lengths)
    matrix = off.T @ off / np.where(products > 0, products, 1.0)
    matrix = 0.5 * (matrix + matrix.T)
    matrix[np.diag_indices(e.shape[1])] = 1.0
    return np.asarray(matrix)


def joint_limit(arl0: float, weight: float, learned: Sequence[Prewhitening], rows: float) -> float:
    """The limit of a MEWMA's, or with the weight 1 of a T2's, statistic.

    Args:
        arl0: run length of the chart without a fault.
        weight: lambda.
        learned: the training of each signal.
        rows: number of rows from which the correlations of the signals were estimated.
    """
    dimension = len(learned)
    known = mewma_limit(arl0, dimension, weight)
    freedoms = tuple(degrees_of_freedom(item, weight) for item in learned)
    limit = _estimated_quantile(float(special.chdtrc(dimension, known)), freedoms, rows)
    return limit * (1.0 + (2.0 - weight) / (weight * min(item.rows for item in learned)))


@lru_cache(maxsize=16)
def _estimated_quantile(tail: float, freedoms: tuple[float, ...], rows: float) -> float:
    """See `estimated_t2_quantile`; a chart's design and its rates need the same one."""
    return estimated_t2_quantile(tail, np.array(freedoms), rows)


def joint_rates(share: float, weight: float, baseline: Baseline, errors: TrainingErrors) -> Array:
    """Rate of a MEWMA, or with the weight 1 of a T2, relative to the intended one, shape (draws,).

    Args:
        share: intended probability of a point, or 1 / run length.
        weight: lambda.
        baseline: training of the signals.
        errors: errors of these signals.
    """
    learned, rows = baseline.learned, len(baseline.e)
    known = mewma_limit(1.0 / share, len(learned), weight)
    limit = joint_limit(1.0 / share, weight, learned, rows)
    return joint_relative_rate(known, limit, weight, learned, rows, errors)
