"""Ordinary rows of one plant, which the compiled step takes through all stages (`row_step`)."""

from collections.abc import Sequence

import numpy as np

from monitor_node.baseline.black_box_reference import BlackBoxReference
from monitor_node.baseline.process_reference import ProcessReference
from monitor_node.baseline.references import Reference
from monitor_node.baseline.signal_range import SignalRange
from monitor_node.config import MonitorConfig
from monitor_node.pipeline.row_frame import Records
from monitor_node.pipeline.row_step import FilterNumbers, RowStep, types_of
from reactorwatch.arrays import Array
from reactorwatch.records.record import MINUTE_NS


class OrdinaryRows:
    """Compiled step of one plant, with the numbers that it updates.

    Args:
        config: settings of the monitor.
        ranges: ranges of each input and of each output.

    Attributes:
        numbers: numbers of the stages, shape (1,), see `row_frame.FrameTypes`.
        kalman: numbers of the filter; None where there is no step.
    """

    def __init__(self, config: MonitorConfig, ranges: Sequence[SignalRange]) -> None:
        self._config, self._ranges = config, ranges
        self._step: RowStep | None = None
        self._row = np.empty(len(config.signals))
        self.numbers: Records = np.zeros(1, types_of(config).numbers)
        self.kalman: FilterNumbers | None = None

    def start(self, reference: Reference) -> None:
        """Make the step of a reference, if there is one."""
        self.kalman = None
        if isinstance(reference, BlackBoxReference):
            self._step = RowStep.of_black_box(self._config, reference, self._ranges)
        else:
            model = reference.model if isinstance(reference, ProcessReference) else None
            self._step = RowStep.of(self._config, model, self._ranges)
        if self._step is not None and isinstance(reference, ProcessReference | BlackBoxReference):
            belief, variances = reference.numbers
            self.kalman = FilterNumbers(belief[None], variances[None])

    def stop(self) -> None:
        """Take no row, until the next start."""
        self._step = self.kalman = None

    def take(self, time_ns: int, values: Sequence[float]) -> int:
        """Take a row through all stages; returns the verdict, see `row_step`."""
        assert self._step is not None
        assert self.kalman is not None
        self._row[:] = values
        return self._step.update(self.numbers, self.kalman, time_ns, time_ns / MINUTE_NS, self._row)

    @property
    def predictions(self) -> tuple[list[float], list[float], list[float], list[float]]:
        """Predictions of the newest row, standard deviations and normalised residuals, and expected values of these."""
        work, count = self._work, len(self._config.outputs)
        outputs, expected = work["outputs"].tolist(), work["expected"].tolist()
        return outputs[:count], outputs[2 * count : 3 * count], outputs[3 * count : 4 * count], expected

    @property
    def points(self) -> Array:
        """Points of the charts of the newest row, see `ChartWatch.points`."""
        points: Array = self._work["points"]
        return points

    @property
    def _work(self) -> np.void:
        assert self._step is not None
        work: np.void = self._step.work[0]
        return work
