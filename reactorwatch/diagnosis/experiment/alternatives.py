"""Several alternatives with the same input and the same limits."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.experiment.alternative import Prediction
from reactorwatch.diagnosis.experiment.constraints import Limits, keeps_limits, limits_of
from reactorwatch.diagnosis.experiment.input_sequence import InputRange
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import FittedHypothesis
from reactorwatch.process.model import ProcessModel

MARGIN_SD = 3.0
"""Margin of an output to its limits, in standard deviations of its noise, so that the measurements keep them."""

REST_ROWS = 300


class Predictions:
    """Explanations of one record, extrapolated with other levels of the first input.

    Args:
        hypotheses: hypotheses fitted to the record.
        run: the record.
        model: process model without their causes.
        noise: noise levels of the plant and its sensors.
        given: limits by signal; for the others see `limits_of`.
        pattern_rows: rows of the pattern, see `Prediction`.

    Attributes:
        pairs: indices of every two of them.
        limits: limits of every signal.
        rest: level of the first input at which the plant settles before, its median in the record.
        period_min: sampling period.
    """

    def __init__(
        self,
        hypotheses: Sequence[FittedHypothesis],
        run: Run,
        model: ProcessModel,
        noise: Noise,
        given: Mapping[str, tuple[float, float]],
        pattern_rows: int,
    ) -> None:
        self._outputs = model.output_names
        self._margin = MARGIN_SD * noise.sensor_sd(model.output_names)
        self.limits: Limits = limits_of(run, model, given)
        self.period_min = float(np.median(np.diff(run.time_min)))
        low, high = self.limits[model.input_names[0]]
        self._resting = np.median(run.inputs, axis=0)
        rest = min(max(float(self._resting[0]), low), high)
        self._resting[0] = self.rest = float(InputRange(low, high, rest).levels(np.zeros(1))[0])
        for item in hypotheses:
            item.hypothesis.filter.noise = noise
        pattern_min = pattern_rows * self.period_min
        self.members = tuple(
            Prediction(item.hypothesis, item.fit, run, self._resting, REST_ROWS, pattern_min) for item in hypotheses
        )
        self.pairs = list(combinations(range(len(self.members)), 2))

    def runs(self, levels: Array) -> list[Run] | None:
        """Noise-free records that each predicts; None if an output of any leaves its limits.

        Args:
            levels: levels of the first input, shape (rows,).
        """
        time_min = self.members[0].start_min + self.period_min * np.arange(levels.size, dtype=np.float64)
        inputs = np.tile(self._resting, (levels.size, 1))
        inputs[:, 0] = levels
        result = []
        for alternative in self.members:
            outputs = alternative.predict_outputs(time_min, inputs)
            if outputs is None or not keeps_limits(outputs, self.limits, self._outputs, self._margin):
                return None
            result.append(Run(time_min, inputs, outputs))
        return result

    def noncentrality(self, pair: tuple[int, int], runs: Sequence[Run]) -> float:
        """Part of the first's prediction that the second of a pair cannot imitate, linearised."""
        true, other = pair
        return self.members[other].noncentrality(runs[true])

    def noncentralities(self, runs: Sequence[Run]) -> dict[tuple[int, int], float]:
        """Twice the log likelihood ratio of each, if true, over each other, without noise.

        Unlike `noncentrality` it comes from fits, so it contains the nonlinearity of the equations.
        """
        result = {}
        for true, run in enumerate(runs):
            own = self.members[true].own_loss(run)
            for other, alternative in enumerate(self.members):
                if other != true:
                    result[true, other] = max(2.0 * (alternative.loss(run) - own), 0.0)
        return result
