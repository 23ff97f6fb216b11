"""The charts of a plant, made from its training: what a standard deviation is, and where limits lie."""

from itertools import compress
from math import sqrt
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from monitor_node.config import MonitorConfig
from reactorwatch.spc import false_alarm_budget as budget
from reactorwatch.spc.charts.base import SignalChart
from reactorwatch.spc.charts.cusum import Cusum
from reactorwatch.spc.charts.ewma import Ewma
from reactorwatch.spc.charts.mewma import Mewma
from reactorwatch.spc.charts.pca import PcaModel, PcaSpe, PcaT2
from reactorwatch.spc.charts.shewhart import Shewhart
from reactorwatch.spc.charts.t2 import T2
from reactorwatch.spc.prewhitening import Prewhitening
from reactorwatch.spc.run_length.mewma import LARGEST_DIMENSION_WITHOUT_SHIFT as LARGEST_DIMENSION

Array = NDArray[np.float64]

ROWS_AN_OUTPUT = 2
"""Rows of the training that a chart of all outputs needs for each: with fewer their correlations are hardly known."""

LEAST_VARIANCE = 1e-8
"""Share of one output's own variance that a combination of outputs must have; with less it varies by rounding only."""

VectorChart: TypeAlias = T2 | Mewma | PcaT2 | PcaSpe


class ChartDesign:
    """Makes charts.

    Args:
        config: of the monitor.
        learned: from the training, one an output.
        e: the training's prewhitened residuals, shape (n, outputs); NaN where there is none.
        evaluated: which outputs are evaluated; the others have charts of their own that get no values, and no part in
            those of all outputs.
        arl0: run length of each alarm without a fault, in rows.

    Attributes:
        widths: of the Shewhart limits, one an output, in standard deviations.
    """

    def __init__(
        self, config: MonitorConfig, learned: list[Prewhitening], e: Array, evaluated: list[bool], arl0: float
    ) -> None:
        self._config, self._learned, self._arl0 = config, learned, arl0
        self._p = budget.point_probability(arl0, config.raise_count, config.window)
        self._memory = _long_memory(e, config.ewma_weight)
        self._together = np.flatnonzero(evaluated)
        self._e = _complete(e, evaluated)
        self._covariance = _correlation(self._e)
        self.widths = [budget.shewhart_width(self._p, item) for item in learned]

    def of_each(self, name: str) -> list[SignalChart]:
        """A chart of that name for each output."""
        config, arl0 = self._config, self._arl0
        if name == Shewhart.name:
            return [Shewhart(0.0, 1.0, width) for width in self.widths]
        pairs = zip(self._memory, self._learned, strict=True)
        if name == Ewma.name:
            weight = config.ewma_weight
            return [Ewma(0.0, sd, weight, budget.ewma_width(arl0, weight, learned)) for sd, learned in pairs]
        k = config.cusum_allowance
        return [Cusum(0.0, sd, k, budget.cusum_height(arl0, k, learned)) for sd, learned in pairs]

    def of_all(self, name: str) -> VectorChart:
        """A chart of that name of all outputs together."""
        weight, count = self._config.mewma_weight, self._together.size
        mean, learned = [0.0] * count, [self._learned[place] for place in self._together]
        if name == Mewma.name:
            memory = np.array(self._memory)[self._together]
            covariance = self._covariance * np.outer(memory, memory)
            return Mewma(mean, covariance, weight, budget.joint_limit(self._arl0, weight, learned, len(self._e)))
        if name == T2.name:
            return T2(mean, self._covariance, budget.joint_limit(1.0 / self._p, 1.0, learned, len(self._e)))
        model = PcaModel.fit(self._e, count - 1, self._p)
        return PcaT2(model) if name == PcaT2.name else PcaSpe(model)


def joint_obstacle(name: str, outputs: tuple[str, ...], e: Array, evaluated: list[bool]) -> str:
    """The reason why there can be no chart of all outputs together; empty if there can.

    Args:
        name: of the chart.
        outputs: names of the outputs.
        e: the training's prewhitened residuals, shape (n, outputs); NaN where there is none.
        evaluated: which outputs are evaluated.
    """
    names, rows = list(compress(outputs, evaluated)), _complete(e, evaluated)
    count = len(names)
    if count < 2:
        return "it needs two outputs or more"
    if count > LARGEST_DIMENSION:
        return f"it takes at most {LARGEST_DIMENSION} outputs, got {count}"
    if len(rows) < ROWS_AN_OUTPUT * count:
        return (
            f"the training has {len(rows)} rows in which all {count} outputs could be learned from, "
            f"{ROWS_AN_OUTPUT * count} are needed"
        )
    sizes, directions = np.linalg.eigh(_correlation(rows))
    if sizes[0] < LEAST_VARIANCE:
        alike = [names[place] for place in np.flatnonzero(np.abs(directions[:, 0]) > 0.1)]
        return f"one of the outputs {', '.join(alike)} follows from the others"
    if name in (PcaT2.name, PcaSpe.name) and not np.all(np.ptp(rows, axis=0) > 0.0):
        still = names[int(np.argmin(np.ptp(rows, axis=0)))]
        return f"the residual of {still} does not vary in the training"
    return ""


def _complete(e: Array, evaluated: list[bool]) -> Array:
    """The rows in which no evaluated output is missing, shape (rows, evaluated outputs)."""
    e = e[:, np.flatnonzero(evaluated)]
    return e[np.all(np.isfinite(e), axis=1)]


def _correlation(e: Array) -> Array:
    """Of the outputs' residuals, shape (outputs, outputs); none with one that does not vary."""
    off = e - e.mean(axis=0) if len(e) else np.zeros((1, e.shape[1]))
    lengths = np.linalg.norm(off, axis=0)
    products = np.outer(lengths, lengths)
    matrix = off.T @ off / np.where(products > 0, products, 1.0)
    matrix = 0.5 * (matrix + matrix.T)
    matrix[np.diag_indices(e.shape[1])] = 1.0
    return np.asarray(matrix)


def _long_memory(e: Array, weight: float) -> list[float]:
    """What a chart with a memory must take for one standard deviation of each output; 1 if the residual is white.

    An autoregression of few coefficients may miss a correlation over many rows. It shows in averages: theirs should
    have the variance weight / (2 - weight). Where it is larger by more than chance allows, limits follow it.
    """
    found = []
    for column in e.T:
        column = column[np.isfinite(column)]
        average, squares = 0.0, 0.0
        for value in column.tolist():
            average += weight * (value - average)
            squares += average * average
        ratio = squares / max(len(column), 1) * (2.0 - weight) / weight
        independent = max(len(column) * weight / 2.0, 1.0)
        found.append(sqrt(ratio) if ratio > 1.0 + 3.0 * sqrt(2.0 / independent) else 1.0)
    return found
