"""Regressors of a linear model from a record.

A row is only predicted from rows that are complete and follow each other without a gap.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.errors import InputError
from reactorwatch.identification.structure import ALL_ROWS, RowChoice, Structure, as_columns

GAP_TOLERANCE = 0.25
"""An interval that differs from the period by more than this share of it is a gap."""


@dataclass(frozen=True)
class Rows:
    """The rows of a record that a model can be fitted to.

    Attributes:
        regressors: shape (rows, parameters).
        outputs: shape (rows, 1).
        position: index of each row in the record, from 0, shape (rows,).
    """

    regressors: NDArray[np.float64]
    outputs: NDArray[np.float64]
    position: NDArray[np.int64]


def rows_of(
    structure: Structure,
    inputs: ArrayLike,
    outputs: ArrayLike,
    time: ArrayLike | None = None,
    choice: RowChoice = ALL_ROWS,
) -> Rows:
    """Rows of a record that can be predicted from complete rows without a gap between them.

    Args:
        structure: structure of the model.
        inputs: shape (rows,) or (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows,) or (rows, 1), NaN where nothing was measured.
        time: shape (rows,), increasing, in any unit; None: gaps are not detected.
        choice: rows that are fitted.

    Raises:
        InputError: shapes that don't fit, or times that don't increase.
    """
    u = as_columns(inputs, "inputs", structure.inputs)
    y = as_columns(outputs, "outputs", 1)
    if len(u) != len(y):
        raise InputError(f"inputs and outputs must have equally many rows, got {len(u)} and {len(y)}")
    count, reach = len(y), structure.history
    run = consecutive_rows(np.concatenate([u, y], axis=1), time)
    wanted = np.arange(count)
    position = wanted[(run > reach) & choice.takes(wanted)]
    columns = [y[position - lag] for lag in range(1, structure.output_lags + 1)]
    columns += [u[position - structure.delay - lag] for lag in range(structure.input_lags)]
    if structure.offset:
        columns.append(np.ones((position.size, 1)))
    return Rows(np.concatenate(columns, axis=1), y[position], position)


def consecutive_rows(signals: NDArray[np.float64], time: ArrayLike | None = None) -> NDArray[np.int64]:
    """Number of complete rows without a gap up to and including each row; 0 for an incomplete one.

    Args:
        signals: shape (rows, signals), NaN where nothing was measured.
        time: shape (rows,), increasing; the period is the median interval. Without it no gap is looked for.

    Raises:
        InputError: times that don't fit, or don't increase.
    """
    complete = np.asarray(np.isfinite(signals).all(axis=1))
    count = complete.size
    position = np.arange(count)
    starts = np.where(complete, -1, position + 1)
    if time is not None and count > 1:
        times = np.asarray(time, dtype=np.float64)
        if times.shape != (count,):
            raise InputError(f"time must have the shape ({count},), got {times.shape}")
        intervals = np.diff(times)
        if not np.all(intervals > 0.0):
            row = int(np.argmin(intervals > 0.0)) + 1
            raise InputError(f"time must increase, got {times[row]} after {times[row - 1]} in row {row + 1}")
        period = np.median(intervals)
        gap = np.abs(intervals - period) > GAP_TOLERANCE * period
        starts[1:] = np.where(gap & complete[1:], position[1:], starts[1:])
    return np.where(complete, position - np.maximum(np.maximum.accumulate(starts), 0) + 1, 0)
