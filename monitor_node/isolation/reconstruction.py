"""What a sensor would read were it right.

From its fault on the sensor is left out of the filter, and what it should read is told by the balances and by the other
sensors. It is not corrected by the size of its fault: that would be as good only as the form of the fault is known, and
this holds for a sensor that drifts, sticks or fails in any other way. What it costs is some noise more.
"""

from collections.abc import Iterable, Sequence
from math import isfinite, nan, sqrt

from monitor_node.isolation.window import MOST_PIECES, Row, newest_rows
from reactorwatch.kalman.ekf import Filter, FilterState, NoiseLevels
from reactorwatch.kalman.step_budget import STEPS_PER_PREDICTION, STEPS_PER_ROW, BudgetExceededError, StepBudget
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import StoredState

MARGIN_MIN = 1.0
"""So long before the onset that was found the sensor is left out already."""

START_STEPS, START_STEPS_A_ROW = 25_000 + STEPS_PER_PREDICTION * MOST_PIECES, STEPS_PER_ROW
"""Filter steps that the rows from before may take: enough for each row and a search for steady states."""


class ReconstructionState(StoredState, frozen=True):
    """What is remembered: of the filter, and the newest input that was not missing; NaN before the first."""

    filter: FilterState
    last_input: float


class Reconstruction:
    """Follows a plant without one of its sensors.

    Args:
        model: of the plant.
        noise: of the plant and its sensors.
        place: of the output that the sensor shows, among those of the model.
        rows: newest last, from before the onset on.
        onset_min: when its fault set in.
    """

    def __init__(
        self, model: ProcessModel, noise: NoiseLevels, place: int, rows: Iterable[Row], onset_min: float
    ) -> None:
        self._filter = Filter(model, noise)
        self._place = place
        self._variance = noise.measurement_sd[place] ** 2
        self._input = nan
        past = newest_rows(list(rows))
        self._filter.budget = StepBudget(START_STEPS + START_STEPS_A_ROW * len(past))
        try:
            for time_min, input_value, measured in past:
                self._step(time_min, input_value, measured, right=time_min < onset_min - MARGIN_MIN)
        except BudgetExceededError:  # the filter loses the plant again and again: it begins with the next row instead
            self._filter.restart()
        self._filter.budget = None

    @property
    def state(self) -> ReconstructionState:
        """All that is remembered."""
        return ReconstructionState(self._filter.state, self._input)

    def restore(self, state: ReconstructionState) -> None:
        """Go on where another of the same sensor was when `state` was taken."""
        self._filter.state, self._input = state.filter, state.last_input

    def update(self, time_min: float, input_value: float, measured: Sequence[float]) -> tuple[float, float]:
        """Take a row in.

        Args:
            time_min: of the row.
            input_value: NaN if missing: it is taken to be as it was.
            measured: by all sensors; NaN where missing.

        Returns:
            What the sensor would read but for its noise, and the standard deviation of that, in the output's unit; NaN
            in the row that the filter begins with.
        """
        return self._step(time_min, input_value, measured, right=False)

    def _step(
        self, time_min: float, input_value: float, measured: Sequence[float], *, right: bool
    ) -> tuple[float, float]:
        if isfinite(input_value):
            self._input = input_value
        if not isfinite(self._input):
            return nan, nan
        seen = list(measured)
        if not right:
            seen[self._place] = nan
        found = self._filter.update(time_min, (self._input,), seen)
        variance = found.sd[self._place] ** 2 - self._variance
        return found.prediction[self._place], sqrt(max(variance, 0.0)) if variance == variance else nan
