"""Several rivals, run with the same input and held to the same limits."""

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.experiment.alternative import Rival
from reactorwatch.diagnosis.experiment.constraints import Limits, limits_of, within
from reactorwatch.diagnosis.experiment.input_sequence import Ends
from reactorwatch.diagnosis.fitting.colored_noise import Noise
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.search.search import Explained
from reactorwatch.process.model import ProcessModel

MARGIN_SD = 3.0
"""Standard deviations of its noise that an output stays away from its limits, so that what is measured keeps them."""

REST_ROWS = 300


class Rivals:
    """Explanations of one record, going on after its end with other levels of the first input.

    Args:
        explained: fitted to the record.
        run: the record.
        model: without any of their causes.
        noise: of the plant and its sensors.
        given: limits, by signal; of the others see `limits_of`.
        pattern_rows: see `Rival`.

    Attributes:
        pairs: places of every two of them.
        limits: of every signal.
        rest: level of the first input at which the plant settles before; what it mostly was.
        period_min: between two rows.
    """

    def __init__(
        self,
        explained: Sequence[Explained],
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
        self._resting[0] = self.rest = float(Ends(low, high, rest).levels(np.zeros(1))[0])
        for item in explained:
            item.hypothesis.sized.noise = noise
        pattern_min = pattern_rows * self.period_min
        self.members = tuple(
            Rival(item.hypothesis, item.fit, run, self._resting, REST_ROWS, pattern_min) for item in explained
        )
        self.pairs = list(combinations(range(len(self.members)), 2))

    def runs(self, levels: Array) -> list[Run] | None:
        """What each predicts, as records without noise; None if under one of them an output leaves its limits.

        Args:
            levels: of the first input, shape (rows,).
        """
        time_min = self.members[0].begin_min + self.period_min * np.arange(levels.size, dtype=np.float64)
        inputs = np.tile(self._resting, (levels.size, 1))
        inputs[:, 0] = levels
        found = []
        for rival in self.members:
            outputs = rival.outputs(time_min, inputs)
            if outputs is None or not within(outputs, self.limits, self._outputs, self._margin):
                return None
            found.append(Run(time_min, inputs, outputs))
        return found

    def unexplained(self, pair: tuple[int, int], runs: Sequence[Run]) -> float:
        """What the second of a pair cannot imitate of what the first predicts."""
        true, other = pair
        return self.members[other].unexplained(runs[true])

    def noncentralities(self, runs: Sequence[Run]) -> dict[tuple[int, int], float]:
        """Twice the log likelihood of each of them, if it is true, over each other, without what chance brings.

        Unlike what is `unexplained` it is taken from fits, and so as far from linear as the equations are.
        """
        found = {}
        for true, run in enumerate(runs):
            own = self.members[true].own_loss(run)
            for other, rival in enumerate(self.members):
                if other != true:
                    found[true, other] = max(2.0 * (rival.loss(run) - own), 0.0)
        return found
