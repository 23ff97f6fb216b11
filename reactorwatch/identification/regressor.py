"""Regressors of a linear model, row by row or from a whole record.

A row is only predicted from rows that are complete and follow each other without a gap. After a gap or a missing value
the history restarts.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import isfinite

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.errors import InputError
from reactorwatch.identification.structure import ALL_ROWS, RowChoice, Structure, as_columns
from reactorwatch.stored_state import Memory

GAP_TOLERANCE = 0.25
"""An interval that differs from the period by more than this share of it is a gap."""


class RegressorBuffer(Memory):
    """Turns rows into regressors, row by row. The object is its own memory.

    >>> buffer = RegressorBuffer(Structure.of_order(1))
    >>> buffer.update(0, [10.0], [1.0]) is None  # no history before the first row
    True
    >>> buffer.update(1, [20.0], [2.0])  # y[k-1], u[k-1], 1
    array([ 1., 10.,  1.])

    Args:
        structure: structure of the model.
        choice: rows that are fitted; rows are counted from the first one.
        outputs: outputs that the next regressor needs, newest first; fewer while the history fills.
        inputs: inputs of the same rows, one row after the other.
        last_time_ns: time of the newest row; None before the first.
        row: index of the next row, from 0.

    Raises:
        ValueError: the rows do not fit the structure.
    """

    structure: Structure
    choice: RowChoice = ALL_ROWS
    # Flat lists: a regressor is a dozen numbers, and slicing a list of a dozen takes a fraction of the overhead of a
    # NumPy call.
    outputs: list[float] = msgspec.field(default_factory=list)
    inputs: list[float] = msgspec.field(default_factory=list)
    last_time_ns: int | None = None
    row: int = 0

    def __post_init__(self) -> None:
        filled, most = len(self.outputs), self.structure.history
        if len(self.inputs) != filled * self.structure.inputs or filled > most:
            raise ValueError(f"there must be at most {most} equal rows, got {filled}")

    @property
    def upcoming(self) -> NDArray[np.float64] | None:
        """Regressor of the next row, shape (parameters,); None while the history fills."""
        return self._upcoming(self.structure.history)

    def _upcoming(self, history: int) -> NDArray[np.float64] | None:
        structure = self.structure
        if len(self.outputs) < history:
            return None
        first, last = (structure.delay - 1) * structure.inputs, (structure.delay - 1 + structure.input_lags)
        values = self.outputs[: structure.output_lags]
        values += self.inputs[first : last * structure.inputs]
        if structure.offset:
            values.append(1.0)
        return np.array(values)

    def restart(self) -> None:
        """Clear the history, as after a gap."""
        self.outputs, self.inputs, self.last_time_ns = [], [], None

    def update(self, time_ns: int, inputs: Iterable[float], outputs: Iterable[float]) -> NDArray[np.float64] | None:
        """Add a row.

        Args:
            time_ns: time of the row.
            inputs: shape (inputs,), NaN for what was not measured.
            outputs: shape (1,), NaN for what was not measured.

        Returns: The regressor of this row, from the rows before it, shape (parameters,). None for a row that cannot be
            predicted (its history is incomplete), has a missing value, or is not chosen.

        Raises:
            ValueError: a time not after the last one's, or a wrong number of values; nothing is changed then.
        """
        structure = self.structure
        new_inputs, new_outputs = list(map(float, inputs)), list(map(float, outputs))
        if len(new_inputs) != structure.inputs or len(new_outputs) != 1:
            raise ValueError(
                f"a row must have {structure.inputs} inputs and 1 outputs, got {len(new_inputs)} and {len(new_outputs)}"
            )
        if self.last_time_ns is not None and time_ns <= self.last_time_ns:
            raise ValueError(f"time_ns must increase, got {time_ns} after {self.last_time_ns}")
        complete = all(map(isfinite, new_inputs)) and all(map(isfinite, new_outputs))
        history = structure.history
        is_wanted = complete and (self.choice is ALL_ROWS or self.choice.takes(self.row))
        regressor = self._upcoming(history) if is_wanted else None
        if complete:
            self.outputs = new_outputs + self.outputs[: history - 1]
            self.inputs = new_inputs + self.inputs[: (history - 1) * structure.inputs]
        else:
            self.restart()
        self.last_time_ns = time_ns
        self.row += 1
        return regressor


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
