"""Predictions of many outputs by their fitted ARX models, in one compiled call a row.

`ArxPredictor` predicts one output, with a model that adapts. Where the rows of a plant of many signals need predictions
for its signal checks only, the models stay as fitted, and the calls would cost more than all else.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from monitor_node.baseline.predictor import ArxPredictor
from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import Entry, jit
from reactorwatch.stored_state import StoredState, pack_numbers, unpack_numbers

COLUMNS = 6
"""Whole numbers of a model: lags of the output, lags of the inputs, delay, inputs, rows before a prediction, first
coefficient."""


@jit
def predict_row(
    models: NDArray[np.int64], theta: Array, past: Array, counts: NDArray[np.int64], row: Array, predictions: Array
) -> int:
    """Predict a row, then take it into the past; returns the number of predicted outputs.

    Args:
        models: whole numbers of each model, shape (outputs, `COLUMNS`).
        theta: coefficients of all models in the signals' units: of the output's lags, of the inputs lag by lag, offset.
        past: rows before, the newest first, shape (rows, inputs + outputs).
        counts: complete rows before, up to those that a prediction needs, shape (outputs,).
        row: the inputs and the outputs; NaN where missing.
        predictions: filled, shape (outputs,); NaN where there is none.
    """
    outputs, predicted = counts.size, 0
    all_inputs = row.size - outputs
    for i in range(outputs):
        lags, input_lags, delay = models[i, 0], models[i, 1], models[i, 2]
        inputs, history, at = models[i, 3], models[i, 4], models[i, 5]
        complete = np.isfinite(row[all_inputs + i])
        for j in range(inputs):
            complete = complete and np.isfinite(row[j])
        predictions[i] = np.nan
        if complete and history > 0 and counts[i] >= history:
            value = 0.0
            for lag in range(lags):
                value += theta[at + lag] * past[lag, all_inputs + i]
            for lag in range(input_lags):
                for j in range(inputs):
                    value += theta[at + lags + lag * inputs + j] * past[delay - 1 + lag, j]
            predictions[i] = value + theta[at + lags + input_lags * inputs]
            predicted += 1
        counts[i] = min(counts[i] + 1, history) if complete else 0
    for k in range(past.shape[0] - 1, 0, -1):
        past[k] = past[k - 1]
    past[0] = row
    return predicted


_PREDICT_ROW = Entry(predict_row)


class ArxBankState(StoredState, frozen=True):
    """State of a bank: doubles, the rows before (newest first) and the counts of complete ones."""

    past: bytes
    counts: list[int]


class ArxBank:
    """Fitted ARX models of all outputs of a plant.

    Args:
        predictors: predictors of the outputs, after their fit.
        inputs: number of inputs of the plant.
    """

    def __init__(self, predictors: Sequence[ArxPredictor], inputs: int) -> None:
        fitted = [predictor.linear_reference for predictor in predictors]
        self._models = np.zeros((len(fitted), COLUMNS), np.int64)
        coefficients: list[float] = []
        for row, model in zip(self._models, fitted, strict=True):
            if model is not None:
                shape = model.structure
                used = shape.input_lags if shape.inputs else 0
                row[:] = shape.output_lags, used, shape.delay, shape.inputs, shape.history, len(coefficients)
                coefficients += model.coefficients
        self._theta = np.array([*coefficients, 0.0])
        self._inputs, self._row = inputs, np.empty(inputs + len(fitted))
        self._past = np.full((max(int(self._models[:, 4].max()), 1), self._row.size), np.nan)
        self._counts = np.zeros(len(fitted), np.int64)
        self._predictions = np.empty(len(fitted))
        for index, model in enumerate(fitted):
            if model is None:
                continue
            self._counts[index] = rows = len(model.outputs)
            self._past[:rows, inputs + index] = model.outputs
            if rows and model.structure.inputs:
                self._past[:rows, :inputs] = model.inputs

    @property
    def state(self) -> ArxBankState:
        """A copy of the state, without the models."""
        return ArxBankState(pack_numbers(self._past), self._counts.tolist())

    def restore(self, state: ArxBankState) -> None:
        """Resume, bit for bit, from a state.

        Raises:
            ValueError: the state is of other models.
        """
        past = unpack_numbers(state.past, self._row.size)
        if past.shape != self._past.shape or len(state.counts) != self._counts.size:
            raise ValueError(f"rows before must have shape {self._past.shape}, got {past.shape}")
        self._past[:], self._counts[:] = past, state.counts

    def predict(self, inputs: Sequence[float], values: Sequence[float], *, follows: bool) -> list[float]:
        """Predict a row from the rows before; NaN for an output without a prediction.

        Args:
            inputs: one value an input; NaN where missing.
            values: one value an output; NaN where missing.
            follows: True if the row before was one period ago.
        """
        if not follows:
            self._counts[:] = 0
        self._row[: self._inputs], self._row[self._inputs :] = inputs, values
        _PREDICT_ROW.call(self._models, self._theta, self._past, self._counts, self._row, self._predictions)
        predictions: list[float] = self._predictions.tolist()
        return predictions
