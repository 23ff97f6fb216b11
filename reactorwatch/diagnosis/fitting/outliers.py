"""Values that are far off for a moment and back in the next: they say nothing of the plant, and are left out.

What a plant does goes on for some rows, whether the model knows it or not. So what a free run leaves of the record, its
residual, may grow large and may jump, but not there and back; nor may it be pulled there and back, for a free run does
not follow what is measured. A value is an outlier where its residual is off to the same side from those of the rows
before and from those of the rows after, each by their median, by more than these move among themselves.

A value that is grossly off, more than anything around it moves, is told without a model, and first: a filter that
begins at it is lost.
"""

from dataclasses import replace
from math import inf

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.noise_estimation import initial_sensor_sd

FAR = 5.0
"""Standard deviations of the sensor's noise ..."""

SIDE_ROWS = 3
"""How many rows before and after a value it is compared with."""

RANGES = 2.0
"""... and ranges of the values around, that a value has to be off: what a model lacks may peak where an input jumps."""

SHOWN = 0.5
"""So much of it has to show in what was measured, against a line through what is around; of whose moves it has to be
such a share, too."""


def without(run: Run, outliers: NDArray[np.bool_]) -> Run:
    """The run as if these values were missing, and all of a first row with one: a filter begins with a whole row."""
    if not np.any(outliers):
        return run
    missing = outliers.copy()
    missing[0] |= np.any(outliers[0])
    return replace(run, measured=np.where(missing, np.nan, run.measured))


def gross_outliers(measured: Array) -> NDArray[np.bool_]:
    """Which values are off by more than anything around them moves, shape (rows, n_y)."""
    found = np.zeros(measured.shape, dtype=np.bool_)
    for place, column in enumerate(measured.T):
        ordered, count = _ordered(_around(column))
        low, high = ordered[:, 0], _at(ordered, count - 1)
        with np.errstate(invalid="ignore"):
            beyond = np.maximum(low - column, column - high)
            found[:, place] = (count >= SIDE_ROWS) & (beyond > FAR * _noise_sd(column) + RANGES * (high - low))
    return found


def outliers(measured: Array, residual: Array) -> NDArray[np.bool_]:
    """Which values are off for a moment, shape (rows, n_y).

    Args:
        measured: shape (rows, n_y); NaN where missing.
        residual: of a free run, likewise.
    """
    found = np.zeros(residual.shape, dtype=np.bool_)
    for place, (values, column) in enumerate(zip(measured.T, residual.T, strict=True)):
        around = _around(column)
        before, after = _medians(around[:, :SIDE_ROWS]), _medians(around[:, SIDE_ROWS:])
        with np.errstate(invalid="ignore"):
            off = np.maximum(np.minimum(column - before, column - after), np.minimum(before - column, after - column))
            # Where a reactor ignites, and the simulation does not or elsewhere, there are peaks that are none.
            beside = _around(values)
            line = 0.5 * (_medians(beside[:, :SIDE_ROWS]) + _medians(beside[:, SIDE_ROWS:]))
            shows = (np.abs(values - line) > SHOWN * off) & (off > SHOWN * _moves(beside))
            found[:, place] = shows & (off > FAR * _noise_sd(column) + RANGES * _moves(around))
    return found


def _around(column: Array) -> Array:
    """The values before and after each, shape (rows, 2 SIDE_ROWS); NaN beyond the ends."""
    edge = np.full(SIDE_ROWS, np.nan)
    windows = sliding_window_view(np.concatenate([edge, column, edge]), 2 * SIDE_ROWS + 1)
    return np.delete(windows, SIDE_ROWS, axis=1)


def _ordered(values: Array) -> tuple[Array, NDArray[np.int64]]:
    """Each row in order, what is missing as infinity at the end; and how many are not."""
    known = np.isfinite(values)
    return np.sort(np.where(known, values, np.inf), axis=1), np.count_nonzero(known, axis=1)


def _at(ordered: Array, place: NDArray[np.int64]) -> Array:
    return np.asarray(ordered[np.arange(len(ordered)), np.maximum(place, 0)])


def _moves(around: Array) -> Array:
    """Range of what is around without its least and its largest, which may be outliers; infinite if that is little."""
    ordered, count = _ordered(around)
    return np.where(count > SIDE_ROWS, _at(ordered, count - 2) - _at(ordered, np.minimum(1, count - 1)), inf)


def _medians(values: Array) -> Array:
    """Of what is known of each row; NaN where that is nothing."""
    ordered, count = _ordered(values)
    with np.errstate(invalid="ignore"):
        return np.where(
            count > 0, 0.5 * (_at(ordered, (count - 1) // 2) + _at(ordered, count // 2 - (count == 0))), np.nan
        )


def _noise_sd(column: Array) -> float:
    """A standard deviation that outliers hardly move; at least the step of values that come in steps."""
    known = column[np.isfinite(column)]
    if known.size < 2 * SIDE_ROWS:
        return inf
    return max(initial_sensor_sd(known), resolution(known))


def resolution(values: Array) -> float:
    """The least difference of two values; of those that do not come in steps it is next to nothing."""
    steps = np.diff(np.unique(np.round(values[np.isfinite(values)], 9)))
    return float(steps.min()) if steps.size else 0.0
