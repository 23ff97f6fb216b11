"""Inputs that a controller moves in answer to a measurement of the same row.

Such an input has the measurement's noise in it. A correction of the sensor that depends on the input would predict
that noise, which no cause can, and would be better than every explanation by thousands in BIC. In open loop what an
input does in a row is independent of what is measured in that row, given the rows before (the instantaneous causality
of Granger 1969, Investigating causal relations by econometric models and cross-spectral methods, Econometrica 37).
"""

from math import sqrt

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.model import ProcessModel

ANSWERS = 6.0
"""Standard deviations by chance beyond which a correlation is an answer."""

LAGS = 2
"""Rows before that are given."""

Answers = frozenset[tuple[str, str]]
"""Pairs of an output and an input that answers to its measurement."""


def find_answers(model: ProcessModel, run: Run) -> Answers:
    """Find the inputs that answer to a measurement in the same row.

    Args:
        model: process model of the plant.
        run: the record.
    """
    rows = np.column_stack([run.inputs, run.measured])
    now, past = rows[LAGS:], np.hstack([rows[LAGS - lag : len(rows) - lag] for lag in range(1, LAGS + 1)])
    known = np.all(np.isfinite(now), axis=1) & np.all(np.isfinite(past), axis=1)
    past = np.column_stack([np.ones(np.count_nonzero(known)), past[known]])
    if len(past) <= 2 * past.shape[1]:
        return frozenset()
    scale = np.maximum(np.abs(past).max(axis=0), 1e-300)
    new = now[known] - past @ (np.linalg.lstsq(past / scale, now[known], rcond=None)[0] / scale[:, None])
    count = len(model.inputs)
    return frozenset(
        (output, name)
        for output, measured in zip(model.output_names, new[:, count:].T, strict=True)
        for name, moved in zip(model.input_names, new[:, :count].T, strict=True)
        if _correlation_in_sd(measured, moved) > ANSWERS
    )


def _correlation_in_sd(one: Array, other: Array) -> float:
    """Size of a correlation in standard deviations by chance; 0 where one of the two does not vary."""
    norm = float(np.linalg.norm(one) * np.linalg.norm(other))
    return abs(float(one @ other)) / norm * sqrt(one.size) if norm > 0.0 else 0.0
