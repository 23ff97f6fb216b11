"""Measurement delay: the delayed values are shifted back to the time at which they were true.

A delay line would cost a filter many states. But a value that a sensor shows with a delay m is the one that a sensor
without delay showed at t - m. So the filter gets it there, as a row of its own between those of the other sensors. Its
innovation counts for the row in which it was recorded.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.run import Run, input_uncertainty_of
from reactorwatch.kalman.batch import FilterResult, InputUncertainty


class ShiftedRun(NamedTuple):
    """A run with the values of one output shifted in time.

    Attributes:
        run: the run with more rows; its inputs include those that were given for every row.
        record_rows: positions of the record's rows, shape (rows,).
        delayed_rows: positions of the delayed values, shape (rows,).
        before_start: true if the value was true before the filter starts, so that it cannot be predicted, shape
            (rows,).
        uncertainty: intervals in which inputs changed at unknown times; None without any.
    """

    run: Run
    record_rows: NDArray[np.int64]
    delayed_rows: NDArray[np.int64]
    before_start: NDArray[np.bool_]
    uncertainty: InputUncertainty | None = None


def shift_measurements(run: Run, inputs: Array, held: NDArray[np.bool_], output: int, delay_min: Array) -> ShiftedRun:
    """Shift the values of a delayed output.

    Args:
        run: the record.
        inputs: inputs of every row, shape (rows, n).
        held: mask of inputs that are held from their row on; the others belong to their row's measurements.
        output: index of the delayed output.
        delay_min: delay in minutes, shape (rows,), at least 0.
    """
    rows = run.time_min.size
    begins = np.array([0, *run.breaks])
    begun_min = run.time_min[begins[np.searchsorted(begins, np.arange(rows), side="right") - 1]]
    true_min = run.time_min - np.maximum(delay_min, 0.0)
    before = true_min < begun_min
    true_min = np.maximum(true_min, begun_min)
    times, where = np.unique(np.concatenate([run.time_min, true_min]), return_inverse=True)
    prompt, late = where[:rows], where[rows:]
    source = np.clip(np.searchsorted(run.time_min, times, side="right") - 1, 0, rows - 1)
    spread = inputs[source]
    measured = np.full((times.size, run.measured.shape[1]), np.nan)
    for index in range(measured.shape[1]):
        measured[late if index == output else prompt, index] = run.measured[:, index]
    spread[late[:, None], np.flatnonzero(~held)] = inputs[:, ~held]
    uncertainty = input_uncertainty_of(run, spread, np.searchsorted(run.time_min, times, side="left"))
    return ShiftedRun(Run(times, spread, measured), prompt, late, before, uncertainty)


def restore_rows(innovations: FilterResult, by: ShiftedRun, output: int) -> FilterResult:
    """Rearrange a filter run of the shifted rows to the rows of the record."""
    items = [np.array(item[by.record_rows]) for item in innovations]
    for item, whole in zip(items[:5], innovations[:5], strict=True):
        item[:, output] = whole[by.delayed_rows, output]
    return FilterResult(*items)
