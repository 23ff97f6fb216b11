"""Reference by identified models: recursive ARX models, which learn while nothing is wrong.

It serves any plant, but only within the inputs of its training; other rows are not evaluated.
"""

from collections.abc import Sequence
from math import nan, sqrt
from typing import Self

import numpy as np

from monitor_node.baseline.references import RowPrediction
from reactorwatch.arrays import Array
from reactorwatch.stored_state import Memory

MARGIN = 0.1
"""Share of an input's range in training by which it may be beyond it."""

MOST_LEVERAGE = 0.2
"""Largest variance of a prediction due to an input's coefficient, in variances of the residual. Several inputs are
often those of controllers, which leave their range with a fault: rows are judged as far as models are determined."""


class ArxReference(Memory, tag="arx", dict=True):
    """Identified models, one an output; the caller sets their predictions. The object is its own state.

    Attributes:
        low: lower end of the range in which the models hold, one an input.
        high: upper end of it.
        uses_inputs: one flag an output: its model has the inputs.
        predictions: predictions of the next row, one an output.
        extrapolation_sds: see `ArxPredictor.extrapolation_sd`, one an output.
        beyond: indices of the inputs of the newest row that are beyond the training, for models that have them.
    """

    low: list[float]
    high: list[float]
    uses_inputs: list[bool]

    kind = "arx"

    def __post_init__(self) -> None:
        self._sds = [1.0] * len(self.uses_inputs)
        self.predictions: list[float] = []
        self.extrapolation_sds: list[float] = []
        self.beyond: list[int] = []
        self._ranges = list(enumerate(zip(self.low, self.high, strict=True))) if True in self.uses_inputs else []

    @property
    def state(self) -> Self:
        """The object itself."""
        return self

    @classmethod
    def of_training(cls, inputs: Array, uses_inputs: list[bool]) -> Self:
        """Reference after a training.

        Args:
            inputs: inputs of the training, shape (n, inputs).
            uses_inputs: one flag an output: its model has the inputs.
        """
        lows, highs = [], []
        for column in inputs.T:
            finite = column[np.isfinite(column)]
            low, high = (float(finite.min()), float(finite.max())) if finite.size else (-np.inf, np.inf)
            margin = MARGIN * (high - low)
            if inputs.shape[1] > 1 and finite.size:  # an input that did not move has no coefficient
                reach = float(finite.std()) * sqrt(MOST_LEVERAGE * finite.size) if high > low else np.inf
                middle = 0.5 * (low + high)
                margin = max(margin, reach - (high - middle))
            lows.append(low - margin)
            highs.append(high + margin)
        return cls(lows, highs, uses_inputs)

    def update(
        self, time_ns: int, inputs: Sequence[float], values: list[float], accept: tuple[bool, ...], missing: int = 0
    ) -> RowPrediction:
        """See `Reference`. Predictions with an input beyond the training are extrapolations."""
        self.beyond = [i for i, (low, high) in self._ranges if inputs[i] < low or inputs[i] > high]
        extrapolation = self.predictions, self.extrapolation_sds
        if not self.beyond:
            return RowPrediction(self.predictions, self._sds, extrapolation)
        pairs = zip(self.predictions, self.uses_inputs, strict=True)
        judged = [nan if uses_inputs else prediction for prediction, uses_inputs in pairs]
        return RowPrediction(judged, self._sds, extrapolation)

    def restart(self) -> None:
        """Do nothing: the models restart by themselves."""
