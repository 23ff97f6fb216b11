"""All the charts of one plant: built from its training and its budget of false alarms, fed row by row.

What comes in is one prewhitened residual an output, in standard deviations. Which charts look at it is a setting:

- `shewhart` sees a large change within a few rows: an alarm takes several of the last points beyond its limit.
- `ewma` sees a moderate change of one output, `cusum` likewise.
- `mewma` has the longest memory and looks at all outputs together: small lasting changes.
- `t2` looks at all outputs of one row; `pca_t2` and `pca_spe` at what they have in common and what they don't.

A chart with a memory begins anew when its alarm is cleared, so that false alarms do not come in clusters.
"""

from collections.abc import Callable
from math import isfinite, sqrt
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from monitor_node import false_alarm_budget as budget
from monitor_node.alarm_board import AlarmBoard
from monitor_node.alarms import ChartAlarm, Explanation
from monitor_node.charts.base import Judgement, SignalChart
from monitor_node.charts.cusum import Cusum
from monitor_node.charts.ewma import Ewma
from monitor_node.charts.mewma import Mewma
from monitor_node.charts.pca import PcaModel, PcaSpe, PcaT2
from monitor_node.charts.shewhart import Shewhart
from monitor_node.charts.t2 import T2
from monitor_node.config import MonitorConfig, PriorityName
from monitor_node.prewhitening import Prewhitening
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import ChartPoint

Array = NDArray[np.float64]

ALL = "all"
"""What a chart of all outputs together is of."""

SD = "sd"
"""The unit of what charts show: standard deviations of the residual."""

OF_ONE = ("shewhart", "ewma", "cusum")
OF_ALL = ("t2", "mewma", "pca_t2", "pca_spe")
WITHOUT_MEMORY = ("shewhart", "t2", "pca_t2", "pca_spe")
"""An alarm of theirs takes several points, so that a single outlier raises none."""


VectorChart: TypeAlias = T2 | Mewma | PcaT2 | PcaSpe


def alarm_names(config: MonitorConfig) -> list[tuple[str, str]]:
    """(chart, of what) of every alarm that the charts of a plant can raise."""
    of_all = OF_ALL if len(config.outputs) > 1 else ()
    names: list[tuple[str, str]] = []
    for chart in config.charts:
        if chart in OF_ONE:
            names += [(chart, signal) for signal in config.outputs]
        elif chart in of_all:
            names.append((chart, ALL))
    return names


class _OneOutput:
    """A chart of one output."""

    def __init__(self, chart: SignalChart, index: int, signal: str, passed: float) -> None:
        self.chart, self.index, self._signal, self._passed = chart, index, signal, passed

    def update(self, e: list[float], withheld: list[bool]) -> Judgement | None:
        """Judge the output; None if there is nothing to judge."""
        x = e[self.index]
        if not isfinite(x) or (withheld[self.index] and not isinstance(self.chart, Shewhart)):
            return None
        return self.chart.update(x)

    def explain(self, judgement: Judgement, scales: list[float], units: list[str]) -> Explanation:
        """What to say of a point that is out."""
        above = judgement.statistic > judgement.centre
        # What the chart sees, as the shift of the output that would look like that if it lasted.
        size = abs(judgement.statistic) * scales[self.index]
        side = "above" if above else "below"
        unit = units[self.index]
        if isinstance(self.chart, Shewhart):
            allowed = judgement.upper_limit * scales[self.index]
            text = f"{self._signal} is {size:.3g} {unit} {side} what the model expects (allowed: {allowed:.3g} {unit})"
        elif isinstance(self.chart, Ewma):
            text = f"{self._signal} is on average {size / self._passed:.3g} {unit} {side} what the model expects"
        else:
            text = f"{self._signal} has drifted {side} what the model expects"
        return Explanation(text, {self._signal: 1.0})


class _AllOutputs:
    """A chart of all outputs together."""

    def __init__(self, chart: VectorChart, signals: tuple[str, ...]) -> None:
        self.chart, self._signals = chart, signals
        self._last: list[float] = []

    def update(self, e: list[float], withheld: list[bool]) -> Judgement | None:
        """Judge the row; None if an output is missing in it."""
        if True in withheld or not all(map(isfinite, e)):
            return None
        self._last = e
        return self.chart.update(e)

    def explain(self, judgement: Judgement, scales: list[float], units: list[str]) -> Explanation:
        """What to say of a point that is out."""
        chart = self.chart
        parts = chart.contributions() if isinstance(chart, Mewma) else chart.contributions(self._last)
        shares = np.maximum(parts, 0.0) / np.sum(np.maximum(parts, 0.0))
        order = np.argsort(-shares)
        told = " and ".join(f"{self._signals[index]} ({100 * shares[index]:.0f} %)" for index in order)
        text = f"what the model leaves unexplained is unlike the training: {told}"
        return Explanation(text, {self._signals[index]: float(shares[index]) for index in order})


class ChartWatch:
    """The charts of one plant.

    Args:
        config: of the monitor.
        board: the alarms of the plant; those of the charts are declared here.
    """

    def __init__(self, config: MonitorConfig, board: AlarmBoard) -> None:
        self._config = config
        self._board = board
        self._alarms = {
            pair: board.declare(*pair, at_once=pair[0] not in WITHOUT_MEMORY, priority=self._priority(pair[1]))
            for pair in alarm_names(config)
        }
        self._watched: list[tuple[_OneOutput | _AllOutputs, ChartAlarm, str]] = []
        self.widths: list[float] = []
        """Of the Shewhart limits, one an output, in standard deviations; they are shown about the predictions."""

    def _priority(self, signal: str) -> PriorityName | None:
        if signal != ALL:
            return None
        ranks: tuple[PriorityName, ...] = ("low", "medium", "high", "critical")
        return max((self._config.priorities.get(name, "medium") for name in self._config.outputs), key=ranks.index)

    def start(self, learned: list[Prewhitening], e: Array, arl0: float) -> None:
        """Make the charts.

        Args:
            learned: from the training, one an output.
            e: the training's prewhitened residuals, shape (n, outputs), without NaN.
            arl0: run length of each alarm without a fault, in rows.
        """
        config = self._config
        p = budget.point_probability(arl0, config.raise_count, config.window)
        self.widths = [budget.shewhart_width(p, item) for item in learned]
        memory = _long_memory(e, config)
        covariance = _correlation(e)
        self._watched = []
        for (name, signal), alarm in self._alarms.items():
            watched: _OneOutput | _AllOutputs
            if name in OF_ONE:
                index = config.outputs.index(signal)
                chart = self._of_one(name, learned[index], memory[index], arl0, self.widths[index])
                watched = _OneOutput(chart, index, signal, learned[index].passed)
            else:
                watched = _AllOutputs(self._of_all(name, learned, e, covariance, memory, arl0, p), config.outputs)
            key = keys.key(config.plant, keys.CHART, keys.chart_name(name, signal))
            self._watched.append((watched, alarm, key))

    def _of_one(self, name: str, learned: Prewhitening, memory: float, arl0: float, width: float) -> SignalChart:
        config = self._config
        if name == Shewhart.name:
            return Shewhart(0.0, 1.0, width)
        if name == Ewma.name:
            weight = config.ewma_weight
            return Ewma(0.0, memory, weight, budget.ewma_width(arl0, weight, learned))
        k = config.cusum_allowance
        return Cusum(0.0, memory, k, budget.cusum_height(arl0, k, learned))

    def _of_all(
        self,
        name: str,
        learned: list[Prewhitening],
        e: Array,
        covariance: Array,
        memory: list[float],
        arl0: float,
        p: float,
    ) -> VectorChart:
        weight, mean = self._config.mewma_weight, [0.0] * len(learned)
        if name == Mewma.name:
            scale = np.diag(memory)
            limit = budget.joint_limit(arl0, len(learned), weight, learned)
            return Mewma(mean, scale @ covariance @ scale, weight, limit)
        if name == T2.name:
            return T2(mean, covariance, budget.joint_limit(1.0 / p, len(learned), 1.0, learned))
        model = PcaModel.fit(e, len(learned) - 1, p)
        return PcaT2(model) if name == PcaT2.name else PcaSpe(model)

    def update(
        self,
        time_ns: int,
        e: list[float],
        withheld: list[bool],
        scales: list[float],
        units: list[str],
        publications: list[Publication],
        *,
        points: bool,
    ) -> bool:
        """Judge a row.

        Args:
            time_ns: of the row.
            e: the prewhitened residuals; NaN where there is none.
            withheld: outputs whose value may be an outlier and must not enter a memory yet.
            scales: what one standard deviation is, in the outputs' units.
            units: of the outputs.
            publications: what is to be published is added here.
            points: whether the charts' points are to be published.

        Returns:
            Whether an alarm was raised.
        """
        raised = False
        for watched, alarm, key in self._watched:
            judgement = watched.update(e, withheld)
            if judgement is None:
                continue
            if points:
                publications.append(Publication(key, _point(time_ns, judgement)))
            if not judgement.out and alarm.at_rest:
                continue
            stood = alarm.memory.rule.standing
            explain = _explaining(watched, scales, units)
            publications.extend(self._board.judge(alarm, time_ns, judgement, SD, explain))
            stands = alarm.memory.rule.standing
            raised |= stands and not stood
            if stood and not stands:
                watched.chart.restart()
        return raised


def _correlation(e: Array) -> Array:
    """Of the outputs' residuals, shape (outputs, outputs); none with one that does not vary."""
    off = e - e.mean(axis=0) if len(e) else np.zeros((1, e.shape[1]))
    lengths = np.linalg.norm(off, axis=0)
    matrix = off.T @ off / np.where(lengths > 0, np.outer(lengths, lengths), 1.0)
    matrix = 0.5 * (matrix + matrix.T)
    matrix[np.diag_indices(e.shape[1])] = 1.0
    return np.asarray(matrix)


def _explaining(
    watched: _OneOutput | _AllOutputs, scales: list[float], units: list[str]
) -> Callable[[Judgement], Explanation]:
    return lambda judgement: watched.explain(judgement, scales, units)


def _long_memory(e: Array, config: MonitorConfig) -> list[float]:
    """What a chart with a memory must take for one standard deviation of each output; 1 if the residual is white.

    An autoregression of few coefficients may miss a correlation over many rows. It shows in averages: theirs should
    have the variance weight / (2 - weight). Where it is larger by more than chance allows, limits follow it.
    """
    weight = config.ewma_weight
    found = []
    for column in e.T:
        average, squares = 0.0, 0.0
        for value in column.tolist():
            average += weight * (value - average)
            squares += average * average
        ratio = squares / max(len(column), 1) * (2.0 - weight) / weight
        independent = max(len(column) * weight / 2.0, 1.0)
        found.append(sqrt(ratio) if ratio > 1.0 + 3.0 * sqrt(2.0 / independent) else 1.0)
    return found


def _point(time_ns: int, judgement: Judgement) -> ChartPoint:
    return ChartPoint(
        time_ns=time_ns,
        statistic=judgement.statistic,
        centre=judgement.centre,
        lower_limit=judgement.lower_limit,
        upper_limit=judgement.upper_limit,
        out=judgement.out,
    )
