"""Reconstruction of the true reading of a faulty sensor.

From the start of its fault the sensor is left out of the filter, and its true reading is predicted from the balances
and the other sensors. It is not corrected by the size of its fault: that would be only as good as the known form of the
fault, and this holds for a sensor that drifts, sticks or fails in any other way. It costs some accuracy.
"""

from collections.abc import Iterable, Sequence
from math import isfinite, nan, sqrt

from monitor_node.isolation.window import MOST_PIECES, Row, newest_rows
from reactorwatch.kalman.ekf import Filter, FilterState, NoiseLevels
from reactorwatch.kalman.step_budget import STEPS_PER_PREDICTION, STEPS_PER_ROW, BudgetExceededError, StepBudget
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import StoredState

MARGIN_MIN = 1.0
"""Time before the estimated onset from which the sensor is left out."""

START_STEPS, START_STEPS_A_ROW = 25_000 + STEPS_PER_PREDICTION * MOST_PIECES, STEPS_PER_ROW
"""Filter steps for the past rows: enough for each row and a search for steady states."""


class ReconstructionState(StoredState, frozen=True):
    """State of a reconstruction: that of the filter, and the last known inputs; NaN before the first."""

    filter: FilterState
    last_inputs: list[float]


class Reconstruction:
    """Follows a plant without one of its sensors.

    Args:
        model: process model of the plant.
        noise: noise levels of the plant and its sensors.
        index: index of the sensor's output in the model.
        rows: rows from before the onset on, oldest first.
        onset_min: onset of the fault.
    """

    def __init__(
        self, model: ProcessModel, noise: NoiseLevels, index: int, rows: Iterable[Row], onset_min: float
    ) -> None:
        self._filter = Filter(model, noise)
        self._index = index
        self._variance = noise.measurement_sd[index] ** 2
        self._inputs = [nan] * len(model.inputs)
        past = newest_rows(list(rows))
        self._filter.budget = StepBudget(START_STEPS + START_STEPS_A_ROW * len(past))
        try:
            for time_min, inputs, measured in past:
                self._step(time_min, inputs, measured, is_right=time_min < onset_min - MARGIN_MIN)
        except BudgetExceededError:  # the filter diverges again and again: start with the next row instead
            self._filter.restart()
        self._filter.budget = None

    @property
    def state(self) -> ReconstructionState:
        """State of the filter and the last known inputs."""
        return ReconstructionState(self._filter.state, list(self._inputs))

    def restore(self, state: ReconstructionState) -> None:
        """Resume from the state of another reconstruction of the same sensor."""
        self._filter.state, self._inputs = state.filter, list(state.last_inputs)

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
        self._inputs = [now if isfinite(now) else last for now, last in zip(inputs, self._inputs, strict=True)]
        if not all(map(isfinite, self._inputs)):
            return nan, nan
        seen = list(measured)
        if not is_right:
            seen[self._index] = nan
        found = self._filter.update(time_min, self._inputs, seen)
        variance = found.sd[self._index] ** 2 - self._variance
        return found.prediction[self._index], sqrt(max(variance, 0.0)) if variance == variance else nan
