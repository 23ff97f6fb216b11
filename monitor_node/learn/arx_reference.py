"""Reference by identified models: recursive ARX models, which learn while nothing is wrong.

It serves any plant, but only within the inputs of its training; other rows are not evaluated.
"""

from collections.abc import Iterator, Sequence
from math import nan, sqrt

import numpy as np

from monitor_node.learn.arx import ArxPredictor
from monitor_node.learn.identified_models import IdentifiedModels
from monitor_node.learn.references import Reference, RowPrediction
from reactorwatch.arrays import Array
from reactorwatch.process.model import ProcessModel
from reactorwatch.stored_state import Memory

MARGIN = 0.1
"""Share of an input's range in training by which it may be beyond it."""

MOST_LEVERAGE = 0.2
"""Largest variance of a prediction due to an input's coefficient, in variances of the residual. Several inputs are
often those of controllers, which leave their range with a fault: rows are judged as far as models are determined."""


class ArxRanges(Memory, tag="arx"):
    """Ranges of the inputs in which identified models hold.

    Attributes:
        low: lower end of the range in which the models hold, one an input.
        high: upper end of it.
        uses_inputs: one flag an output: its model has the inputs.
    """

    low: list[float]
    high: list[float]
    uses_inputs: list[bool]

    def reference(self, equations: ProcessModel | None, outputs: tuple[str, ...]) -> "ArxReference":
        """Reference with these ranges."""
        return ArxReference(self)


class ArxReference(Reference):
    """Identified models, one an output.

    Args:
        memory: ranges in which the models hold.
        predictors: the models that a training has fitted; without, those of `use_models` predict.
    """

    kind = "arx"
    is_identified = True

    def __init__(self, memory: ArxRanges, predictors: Sequence[ArxPredictor] = ()) -> None:
        self._memory, self._predictors = memory, predictors
        self._models: IdentifiedModels | None = None
        self._beyond: list[int] = []
        self._sds = [1.0] * len(memory.uses_inputs)
        pairs = enumerate(zip(memory.low, memory.high, strict=True))
        self._ranges = list(pairs) if True in memory.uses_inputs else []

    @classmethod
    def of_training(cls, inputs: Array, predictors: Sequence[ArxPredictor]) -> "ArxReference":
        """Reference after a training.

        Args:
            inputs: inputs of the training, shape (n, inputs).
            predictors: the fitted models, one an output.
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
        return cls(ArxRanges(lows, highs, [predictor.uses_inputs for predictor in predictors]), predictors)

    @property
    def memory(self) -> ArxRanges:
        """The ranges in which the models hold: all that is remembered beside the models."""
        return self._memory

    @property
    def typical_sd(self) -> list[float]:
        """See `Reference`."""
        return self._sds

    def use_models(self, models: IdentifiedModels) -> None:
        """Take the identified models of the plant, which judge from now on."""
        self._models = models
        models.start_judging()

    def update(
        self,
        time_ns: int,
        inputs: Sequence[float],
        values: list[float],
        accept: tuple[bool, ...],
        missing: int = 0,
        *,
        follows: bool = True,
    ) -> RowPrediction:
        """See `Reference`. Predictions with an input beyond the training are extrapolations."""
        assert self._models is not None
        predictions = self._models.predict(time_ns, inputs, values, follows=follows)
        extrapolation = predictions, [predictor.extrapolation_sd for predictor in self._models.predictors]
        self._beyond = [i for i, (low, high) in self._ranges if inputs[i] < low or inputs[i] > high]
        if not self._beyond:
            return RowPrediction(predictions, self._sds, extrapolation)
        pairs = zip(predictions, self._memory.uses_inputs, strict=True)
        judged = [nan if uses_inputs else prediction for prediction, uses_inputs in pairs]
        return RowPrediction(judged, self._sds, extrapolation)

    def restart(self) -> None:
        """Do nothing: the models restart by themselves."""

    def set_learning(self, learning: bool) -> None:
        """See `Reference`."""
        if self._models is not None:
            self._models.set_learning(learning)

    def obstacles(self, inputs: Sequence[str]) -> Iterator[tuple[str, str]]:
        """See `Reference`."""
        for name in (inputs[i] for i in self._beyond):
            text = "is beyond its range in the training: the identified model does not hold there"
            yield name, f"rows are not judged while {name} {text}"

    def step_responses(self, rows: int) -> Array:
        """See `Reference`."""
        return np.array([predictor.step_response(rows) for predictor in self._predictors])
