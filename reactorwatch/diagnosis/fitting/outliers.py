"""Outliers: values that deviate for a moment and return in the next row. They carry no information and are removed.

What a plant does lasts for some rows, whether or not the model has it. So the residual of a simulation may grow and
jump, but not there and back; nor do the measurements pull it, for a simulation does not follow them. A value is an
outlier if its residual deviates to the same side from the medians of the rows before and after, by more than these
vary.

Gross outliers deviate more than anything around them varies. They are found first and without a model, because a filter
that starts at one diverges.
"""

from dataclasses import replace
from math import inf

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.noise_estimation import initial_sensor_sd, resolution

FAR = 5.0
"""Required deviation in standard deviations of the sensor's noise ..."""

SIDE_ROWS = 3
"""Number of rows before and after a value that it is compared with."""

RANGES = 2.0
"""... plus ranges of the values around it: model error may peak where an input jumps."""

SHOWN = 0.5
"""Fraction of the deviation that must be visible in the measurements, against a line through the values around; and
fraction of their range that the deviation must exceed."""


def remove_outliers(run: Run, outliers: NDArray[np.bool_]) -> Run:
    """Mark outliers as missing, and all values of a first row with one: a filter starts from a complete row."""
    if not np.any(outliers):
        return run
    missing = outliers.copy()
    missing[0] |= np.any(outliers[0])
    return replace(run, measured=np.where(missing, np.nan, run.measured))


def find_gross_outliers(measured: Array) -> NDArray[np.bool_]:
    """Mask of values that deviate by more than anything around them varies, shape (rows, n_y)."""
    result = np.zeros(measured.shape, dtype=np.bool_)
    for index, column in enumerate(measured.T):
        ordered, count = _sort_rows(_neighbours(column))
        low, high = ordered[:, 0], _at(ordered, count - 1)
        with np.errstate(invalid="ignore"):
            beyond = np.maximum(low - column, column - high)
            result[:, index] = (count >= SIDE_ROWS) & (beyond > FAR * _noise_sd(column) + RANGES * (high - low))
    return result


def find_outliers(measured: Array, residual: Array) -> NDArray[np.bool_]:
    """Mask of values that deviate for a moment, shape (rows, n_y).

    Args:
        measured: measurements, shape (rows, n_y); NaN where missing.
        residual: residual of the simulation, shape (rows, n_y).
    """
    result = np.zeros(residual.shape, dtype=np.bool_)
    for index, (values, column) in enumerate(zip(measured.T, residual.T, strict=True)):
        around = _neighbours(column)
        before, after = _medians(around[:, :SIDE_ROWS]), _medians(around[:, SIDE_ROWS:])
        with np.errstate(invalid="ignore"):
            off = np.maximum(np.minimum(column - before, column - after), np.minimum(before - column, after - column))
            # A reactor that ignites at another time than its simulation causes peaks that are no outliers.
            beside = _neighbours(values)
            line = 0.5 * (_medians(beside[:, :SIDE_ROWS]) + _medians(beside[:, SIDE_ROWS:]))
            shows = (np.abs(values - line) > SHOWN * off) & (off > SHOWN * _moves(beside))
            result[:, index] = shows & (off > FAR * _noise_sd(column) + RANGES * _moves(around))
    return result


def _neighbours(column: Array) -> Array:
    """Values before and after each row, shape (rows, 2 SIDE_ROWS); NaN beyond the ends."""
    edge = np.full(SIDE_ROWS, np.nan)
    windows = sliding_window_view(np.concatenate([edge, column, edge]), 2 * SIDE_ROWS + 1)
    return np.delete(windows, SIDE_ROWS, axis=1)


def _sort_rows(values: Array) -> tuple[Array, NDArray[np.int64]]:
    """Sort each row, with missing values as infinity at the end; also the number of values that are not missing."""
    finite = np.isfinite(values)
    return np.sort(np.where(finite, values, np.inf), axis=1), np.count_nonzero(finite, axis=1)


def _at(ordered: Array, index: NDArray[np.int64]) -> Array:
    return np.asarray(ordered[np.arange(len(ordered)), np.maximum(index, 0)])


def _moves(around: Array) -> Array:
    """Range of the values around without the lowest and the highest, which may be outliers; infinite if too few."""
    ordered, count = _sort_rows(around)
    return np.where(count > SIDE_ROWS, _at(ordered, count - 2) - _at(ordered, np.minimum(1, count - 1)), inf)


def _medians(values: Array) -> Array:
    """Median of each row's values; NaN without any."""
    ordered, count = _sort_rows(values)
    with np.errstate(invalid="ignore"):
        return np.where(
            count > 0, 0.5 * (_at(ordered, (count - 1) // 2) + _at(ordered, count // 2 - (count == 0))), np.nan
        )


def _noise_sd(column: Array) -> float:
    """Robust standard deviation; at least the quantisation step."""
    finite = column[np.isfinite(column)]
    if finite.size < 2 * SIDE_ROWS:
        return inf
    return max(initial_sensor_sd(finite), resolution(finite))
