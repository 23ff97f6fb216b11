"""The charts of a plant, made from its training: what a standard deviation is, and where limits lie."""

from math import sqrt
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from monitor_node import false_alarm_budget as budget
from monitor_node.charts.base import SignalChart
from monitor_node.charts.cusum import Cusum
from monitor_node.charts.ewma import Ewma
from monitor_node.charts.mewma import Mewma
from monitor_node.charts.pca import PcaModel, PcaSpe, PcaT2
from monitor_node.charts.shewhart import Shewhart
from monitor_node.charts.t2 import T2
from monitor_node.config import MonitorConfig
from monitor_node.prewhitening import Prewhitening

Array = NDArray[np.float64]

VectorChart: TypeAlias = T2 | Mewma | PcaT2 | PcaSpe


class ChartDesign:
    """Makes charts.

    Args:
        config: of the monitor.
        learned: from the training, one an output.
        e: the training's prewhitened residuals, shape (n, outputs); NaN where there is none.
        judged: which outputs are judged; the others have charts of their own that nothing is fed to, and no part in
            those of all outputs.
        arl0: run length of each alarm without a fault, in rows.

    Attributes:
        widths: of the Shewhart limits, one an output, in standard deviations.
    """

    def __init__(
        self, config: MonitorConfig, learned: list[Prewhitening], e: Array, judged: list[bool], arl0: float
    ) -> None:
        self._config, self._learned, self._arl0 = config, learned, arl0
        self._p = budget.point_probability(arl0, config.raise_count, config.window)
        self._memory = _long_memory(e, config.ewma_weight)
        self._together = np.flatnonzero(judged)
        e = e[:, self._together]
        self._e = e[np.all(np.isfinite(e), axis=1)]
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
            return Mewma(mean, covariance, weight, budget.joint_limit(self._arl0, count, weight, learned))
        if name == T2.name:
            return T2(mean, self._covariance, budget.joint_limit(1.0 / self._p, count, 1.0, learned))
        model = PcaModel.fit(self._e, count - 1, self._p)
        return PcaT2(model) if name == PcaT2.name else PcaSpe(model)


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
