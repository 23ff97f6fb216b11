"""The watch over one output: its models, its limits, its chart and its alarm."""

from math import isfinite, nan, sqrt

from monitor_node.alarm_board import AlarmBoard
from monitor_node.charts.base import Judgement
from monitor_node.charts.shewhart import Shewhart, probability_out
from monitor_node.config import MonitorConfig
from monitor_node.persistence import false_alarm_rate
from monitor_node.predictor import ArxPredictor
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Publication
from reactorwatch.contract.messages_pb2 import ChartPoint, Estimate, ModelSnapshot

LIMIT_ROWS = 50
"""Fewer residuals than this don't make limits; the training goes on until they are there."""


class Spread:
    """Mean and standard deviation of values that come one by one: Welford (1962), Technometrics 4(3)."""

    def __init__(self) -> None:
        self.count = 0
        self.mean = 0.0
        self._squares = 0.0

    def add(self, value: float) -> None:
        """Take the next value in."""
        self.count += 1
        off = value - self.mean
        self.mean += off / self.count
        self._squares += off * (value - self.mean)

    @property
    def sd(self) -> float:
        """Of a sample, with count - 1; 0 for fewer than two values."""
        return sqrt(self._squares / (self.count - 1)) if self.count > 1 else 0.0


class OutputWatch:
    """Watches one output of a plant.

    Args:
        config: of the monitor.
        signal: the output.
        board: the alarms of the plant.
    """

    def __init__(self, config: MonitorConfig, signal: str, board: AlarmBoard) -> None:
        self.signal = signal
        self._plant = config.plant
        self._width = config.width
        self._predictor = ArxPredictor(config.order, config.delay, config.forgetting)
        self._spread = Spread()
        self._chart: Shewhart | None = None
        self._board = board
        self._alarm = board.declare(Shewhart.name, signal)
        self._estimate_key = keys.key(config.plant, keys.ESTIMATE, signal)
        self._model_key = keys.key(config.plant, keys.MODEL, signal)
        self._chart_key = keys.key(config.plant, keys.CHART, keys.chart_name(Shewhart.name, signal))
        self.false_alarm_rate = false_alarm_rate(config.raise_count, config.window, probability_out(config.width))

    @property
    def watching(self) -> bool:
        """Whether there are limits to judge by."""
        return self._chart is not None

    def update(
        self,
        time_ns: int,
        input_value: float,
        value: float,
        unit: str,
        *,
        follows: bool,
        identifying: bool,
        training: bool,
        publications: list[Publication],
    ) -> None:
        """Take a row in.

        Args:
            time_ns: of the row.
            input_value: of the plant's input, NaN if missing.
            value: of the output, NaN if missing.
            unit: of the output.
            follows: whether the row before was one period ago.
            identifying: whether the model is still to be learned.
            training: whether the limits are still to be learned.
            publications: what is to be published is added here.
        """
        prediction = self._predictor.update(
            time_ns, input_value, value, follows=follows, hold_reference=not identifying
        )
        if not isfinite(prediction):
            return
        residual = value - prediction
        if self._chart is None and self._predictor.has_reference:
            self._spread.add(residual)
            if not training and self._spread.count >= LIMIT_ROWS:
                # A signal without any noise would have limits of no width, and rounding would cross them.
                smallest = 1e-9 * max(abs(value), 1e-300)
                self._chart = Shewhart(self._spread.mean, max(self._spread.sd, smallest), self._width)
                self._publish_estimate(time_ns, prediction, residual, unit, publications)
                publications.extend(self.snapshots(time_ns))
                return
        self._publish_estimate(time_ns, prediction, residual, unit, publications)
        if self._chart is not None:
            judgement = self._chart.update(residual)
            publications.append(self._chart_point(time_ns, judgement))
            publications.extend(self._board.judge(self._alarm, time_ns, judgement, unit))

    def snapshots(self, time_ns: int) -> list[Publication]:
        """The models as they are now: the one that adapts and, once there is one, the reference."""
        models = [(False, self._predictor.adaptive()), (True, self._predictor.reference())]
        return [
            Publication(self._model_key, ModelSnapshot(time_ns=time_ns, reference=reference, **description))
            for reference, description in models
            if description is not None
        ]

    def _publish_estimate(
        self, time_ns: int, prediction: float, residual: float, unit: str, publications: list[Publication]
    ) -> None:
        chart = self._chart
        estimate = Estimate(
            time_ns=time_ns,
            prediction=prediction,
            residual=residual,
            residual_sd=self._spread.sd if chart is not None else 0.0,
            lower_limit=prediction + chart.lower_limit if chart is not None else nan,
            upper_limit=prediction + chart.upper_limit if chart is not None else nan,
            unit=unit,
        )
        publications.append(Publication(self._estimate_key, estimate))

    def _chart_point(self, time_ns: int, judgement: Judgement) -> Publication:
        point = ChartPoint(
            time_ns=time_ns,
            statistic=judgement.statistic,
            centre=judgement.centre,
            lower_limit=judgement.lower_limit,
            upper_limit=judgement.upper_limit,
            out=judgement.out,
        )
        return Publication(self._chart_key, point)
