"""Reconstruction of the true reading of a faulty sensor, from the balances and the other sensors."""

from collections.abc import Iterable, Sequence
from math import isfinite, nan, sqrt

from monitor_node.causes.window import MOST_PIECES, Row, newest_rows
from reactorwatch.kalman.ekf import Filter, FilterState, NoiseLevels
from reactorwatch.kalman.step_budget import STEPS_PER_PREDICTION, STEPS_PER_ROW, BudgetExceededError, StepBudget
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import Memory

MARGIN_MIN = 1.0
"""Time before the estimated onset from which the sensor is left out."""

START_STEPS, START_STEPS_A_ROW = 25_000 + STEPS_PER_PREDICTION * MOST_PIECES, STEPS_PER_ROW
"""Filter steps for the past rows: enough for each row and a search for steady states."""


class ReconstructionMemory(Memory):
    """Memory of a reconstruction.

    Attributes:
        output: output of the sensor.
        cause: suspected cause.
        last_inputs: last known inputs; NaN before the first.
        filter: state of the filter; None before its first row.
    """

    output: str
    cause: str
    last_inputs: list[float]
    filter: FilterState | None = None


class Reconstruction:
    """Reconstructs the true reading of a faulty sensor: follows the plant without it.

    From the start of its fault the sensor is left out of the filter, and its true reading is predicted from the
    balances and the other sensors. It is not corrected by the size of its fault: that would be only as good as the
    known form of the fault, and this holds for a sensor that drifts, sticks or fails in any other way. It costs some
    accuracy.

    Args:
        model: process model of the plant.
        noise: noise levels of the plant and its sensors.
        memory: the sensor, and the memory of an earlier reconstruction of it.
    """

    def __init__(self, model: ProcessModel, noise: NoiseLevels, memory: ReconstructionMemory) -> None:
        self.memory, self._filter = memory, Filter(model, noise)
        self._index = model.output_names.index(memory.output)
        self._variance = noise.measurement_sd[self._index] ** 2
        if memory.filter is not None:
            self._filter.state = memory.filter

    def start(self, rows: Iterable[Row], onset_min: float) -> None:
        """Process the rows from before the onset on, oldest first."""
        past = newest_rows(list(rows))
        self._filter.budget = StepBudget(START_STEPS + START_STEPS_A_ROW * len(past))
        try:
            for time_min, inputs, measured in past:
                self._step(time_min, inputs, measured, is_right=time_min < onset_min - MARGIN_MIN)
        except BudgetExceededError:  # the filter diverges again and again: start with the next row instead
            self._filter.restart()
        self._filter.budget, self.memory.filter = None, self._filter.state

    def update(self, time_min: float, inputs: Sequence[float], measured: Sequence[float]) -> tuple[float, float]:
        """Process a row and return the true reading without noise and its standard deviation, in the output's unit.

        Both are NaN in the row with which the filter starts.

        Args:
            time_min: time of the row.
            inputs: one value an input; NaN if missing: the last known one then holds.
            measured: values of all sensors; NaN where missing.
        """
        return self._step(time_min, inputs, measured, is_right=False)

    def _step(
        self, time_min: float, inputs: Sequence[float], measured: Sequence[float], *, is_right: bool
    ) -> tuple[float, float]:
        known = [now if isfinite(now) else last for now, last in zip(inputs, self.memory.last_inputs, strict=True)]
        self.memory.last_inputs = known
        if not all(map(isfinite, known)):
            return nan, nan
        seen = list(measured)
        if not is_right:
            seen[self._index] = nan
        found = self._filter.update(time_min, known, seen)
        self.memory.filter = self._filter.state
        variance = found.sd[self._index] ** 2 - self._variance
        return found.prediction[self._index], sqrt(max(variance, 0.0)) if variance == variance else nan
