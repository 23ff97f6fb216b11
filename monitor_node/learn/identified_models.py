"""Identified models of a plant: a recursive ARX model for each output, and the bank that predicts them all at once."""

from collections.abc import Sequence
from math import nan

import numpy as np

from monitor_node.config import MonitorConfig
from monitor_node.ingest.alignment import MeasuredRow
from monitor_node.learn.arx import ArxPredictor
from monitor_node.learn.arx_fit import arx_structure, simpler_structures
from monitor_node.learn.training_rows import TrainingRows
from reactorwatch.arrays import Array
from reactorwatch.stored_state import Memory, copy_of


class RowHistory(Memory):
    """Rows before the next one, of models that predict many outputs at once.

    Attributes:
        past: the rows, the newest first, shape (rows * (inputs + outputs),); 0 where missing.
        counts: for each output, complete rows up to those that a prediction needs.
    """

    past: Array
    counts: list[int]


class ArxBank:
    """Fitted ARX models of all outputs of a plant, as one matrix.

    `ArxPredictor` predicts one output, with a model that adapts. Where the rows of a plant of many signals need
    predictions for its signal checks only, the models stay as fitted, and the calls would cost more than all else.

    Args:
        predictors: predictors of the outputs, after their fit.
        inputs: number of inputs of the plant.

    Attributes:
        memory: rows before the next one.
    """

    def __init__(self, predictors: Sequence[ArxPredictor], inputs: int) -> None:
        fitted = [predictor.linear_reference for predictor in predictors]
        outputs, size = len(fitted), inputs + len(fitted)
        self._inputs, rows = inputs, max([1, *(item.structure.history for item in fitted if item is not None)])
        past, theta, counts = np.zeros((rows, size)), np.zeros((outputs, rows, size)), [0] * outputs
        self._offsets, self._history = np.full(outputs, nan), np.zeros(outputs, np.int64)
        self._uses_inputs = np.zeros(outputs, np.bool_)
        for index, item in enumerate(fitted):
            if item is None:
                continue
            shape, of_outputs = item.structure, item.structure.output_lags
            counts[index], self._history[index] = len(item.outputs), shape.history
            past[: len(item.outputs), inputs + index] = item.outputs
            theta[index, :of_outputs, inputs + index] = item.coefficients[:of_outputs]
            self._offsets[index], self._uses_inputs[index] = item.coefficients[-1], shape.inputs > 0
            if shape.inputs:
                past[: len(item.inputs), :inputs] = np.reshape(item.inputs, (-1, inputs))
                of_inputs = np.reshape(item.coefficients[of_outputs:-1], (shape.input_lags, inputs))
                theta[index, shape.delay - 1 : shape.delay - 1 + shape.input_lags, :inputs] = of_inputs
        self._theta = theta.reshape(outputs, -1)
        self.memory = RowHistory(past.ravel(), counts)

    def predict(self, inputs: Sequence[float], values: Sequence[float], *, follows: bool) -> list[float]:
        """Predict a row from the rows before; NaN for an output without a prediction.

        Args:
            inputs: one value an input; NaN where missing.
            values: one value an output; NaN where missing.
            follows: True if the row before was one period ago.
        """
        memory, row = self.memory, np.array([*inputs, *values])
        present = np.isfinite(row)
        complete = present[self._inputs :] & (present[: self._inputs].all() | ~self._uses_inputs)
        counts = np.array(memory.counts) * follows
        predictions = np.where(complete & (counts >= self._history), self._theta @ memory.past + self._offsets, nan)
        memory.counts = np.where(complete, np.minimum(counts + 1, self._history), 0).tolist()
        memory.past = np.concatenate([np.where(present, row, 0.0), memory.past[: -row.size]])
        found: list[float] = predictions.tolist()
        return found


class IdentifiedModels:
    """Identified models of one plant: one an output, which predict each row and are updated with it.

    Where they do not judge, they keep adapting beside the reference. Where rows of many signals need predictions for
    the signal checks only, a bank of the fitted models makes them.

    Args:
        config: settings of the monitor.
        points: True to publish predictions.

    Attributes:
        points: see above.
        adapts: True if the adaptive models are updated where a bank predicts.
        predictors: the models, one an output.
        bank: the fitted models in one call; None where the adaptive ones predict.
    """

    def __init__(self, config: MonitorConfig, *, points: bool) -> None:
        self._config, self.points, self.adapts = config, points, True
        self.predictors: list[ArxPredictor] = []
        self.restart()

    def restart(self) -> None:
        """Start models that know nothing."""
        structure, forgetting = arx_structure(self._config), self._config.forgetting
        self.predictors[:] = [
            ArxPredictor.of(structure, forgetting, with_snapshots=self.points) for _ in self._config.outputs
        ]
        self.bank: ArxBank | None = None

    def resume(self, predictors: Sequence[ArxPredictor], *, follows: bool) -> None:
        """Resume from models of the same settings.

        Args:
            predictors: the models, which are copied.
            follows: True if the next row follows the ones before.

        Raises:
            ValueError: the memory is of other settings.
        """
        wanted = arx_structure(self._config)
        for predictor in predictors:
            if predictor.wanted != wanted or predictor.structure not in (wanted, *simpler_structures(wanted)):
                raise ValueError(f"the state must be of {wanted}, got {predictor.wanted}")
        self.predictors[:] = [copy_of(predictor) for predictor in predictors]
        for predictor in () if follows else self.predictors:
            predictor.restart()

    def learn_again(self, rows: TrainingRows) -> None:
        """Learn from the rows of a training."""
        for predictor, column in zip(self.predictors, rows.outputs.T, strict=True):
            predictor.learn_again(rows.time_min, rows.inputs, column)

    def use_bank(self, *, identified: bool, memory: RowHistory | None = None) -> None:
        """Make the bank, if there is to be one where the identified models predict.

        Args:
            identified: True if the identified models predict.
            memory: rows before the next one; None: those of the adaptive models.

        Raises:
            ValueError: the memory is of other models.
        """
        has_bank = identified and self._config.has_values_only
        self.bank = ArxBank(self.predictors, len(self._config.inputs)) if has_bank else None
        if self.bank is not None and memory is not None:
            if (memory.past.shape, len(memory.counts)) != (self.bank.memory.past.shape, len(self.predictors)):
                raise ValueError(f"rows before must have shape {self.bank.memory.past.shape}, got {memory.past.shape}")
            self.bank.memory = copy_of(memory)

    def start_judging(self) -> None:
        """Judge rows from now on by the adaptive models, unless a bank does, or they do so already."""
        if not (self._config.has_values_only or any(predictor.judges for predictor in self.predictors)):
            for predictor in self.predictors:
                predictor.start_judging()

    def set_learning(self, learning: bool) -> None:
        """Let adaptive models that judge learn, or not."""
        for predictor in () if self.bank is not None else self.predictors:
            predictor.set_learning(learning)

    def predict(self, time_ns: int, inputs: Sequence[float], values: Sequence[float], *, follows: bool) -> list[float]:
        """Predict each output of a row, then update with it.

        Args:
            time_ns: time of the row.
            inputs: one value an input; NaN if missing.
            values: one value an output; NaN if missing.
            follows: True if the row before was one period ago.
        """
        pairs = zip(self.predictors, values, strict=True)
        if self.bank is None:
            return [predictor.update(time_ns, inputs, value, follows=follows) for predictor, value in pairs]
        for predictor, value in pairs if self.adapts else ():
            predictor.update(time_ns, inputs, value, follows=follows)
        return self.bank.predict(inputs, values, follows=follows)

    def update(self, row: MeasuredRow) -> list[float]:
        """Update with a row that is not judged by these models; returns predictions if they are published."""
        pairs = zip(self.predictors, row.values, strict=True)
        found = [predictor.update(row.time_ns, row.inputs, value, follows=row.follows) for predictor, value in pairs]
        return found if self.points else []
