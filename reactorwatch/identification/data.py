"""Rows of a record for a model: measured, complete and consecutive, scaled, and covered by a simulation.

A row is only predicted from rows that are complete and follow each other without a gap.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reactorwatch.arrays import Array
from reactorwatch.codegen.numba_kernel import jit
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.structure import Scaling, Structure, as_columns
from reactorwatch.records.record import Record

PlanArrays: TypeAlias = tuple[NDArray[np.bool_], NDArray[np.bool_]]


@dataclass(frozen=True)
class Dataset:
    """Measured rows of an output and its inputs.

    Attributes:
        time: times of the rows in any unit, shape (rows,), increasing. Rows after a gap are not predicted from rows
            before it.
        inputs: shape (rows, inputs), NaN where nothing was measured. The input of a row is held until the next one.
        output: shape (rows, 1), NaN where nothing was measured.
        input_names: names of the inputs.
        output_name: name of the output.
    """

    time: Array
    inputs: Array
    output: Array
    input_names: tuple[str, ...]
    output_name: str

    @classmethod
    def of(
        cls,
        time: ArrayLike,
        inputs: ArrayLike,
        output: ArrayLike,
        input_names: tuple[str, ...] | None = None,
        output_name: str = "y",
        missing: Literal["refuse", "leave out"] = "refuse",
    ) -> Self:
        """Make a data set from arrays.

        Args:
            time: see `Dataset`.
            inputs: shape (rows,) or (rows, inputs).
            output: shape (rows,) or (rows, 1).
            input_names: names of the inputs; None: u, or u1, u2, ...
            output_name: name of the output.
            missing: treatment of NaN values.

        Raises:
            InputError: shapes that don't fit, infinite values, or missing ones that are refused.
        """
        t, u, y = as_columns(time, "time", 1), as_columns(inputs, "inputs"), as_columns(output, "outputs", 1)
        if not len(t) == len(u) == len(y):
            raise InputError(
                f"time, inputs and outputs must have equally many rows, got {len(t)}, {len(u)} and {len(y)}"
            )
        for name, values in (("time", t), ("inputs", u), ("outputs", y)):
            infinite, absent = np.argwhere(np.isinf(values)), np.argwhere(np.isnan(values))
            if infinite.size:
                row, column = infinite[0]
                raise InputError(f"{name} must be finite, got {values[row, column]} in row {row + 1}")
            if absent.size and (missing == "refuse" or name == "time"):
                cure = "" if name == "time" else ": fill it in, or leave such rows out"
                raise InputError(f"{name} must have a value in every row, got NaN in row {absent[0][0] + 1}{cure}")
        count = u.shape[1]
        numbered = ("u",) if count == 1 else tuple(f"u{i + 1}" for i in range(count))
        return cls(t[:, 0], u, y, numbered if input_names is None else input_names, output_name)

    @classmethod
    def of_record(cls, record: Record, inputs: Sequence[str], output: str) -> Self:
        """Make a data set from a record; rows with missing values are left out of fits.

        Args:
            record: with columns of the signals.
            inputs: names of the inputs.
            output: name of the output.

        Raises:
            InputError: a signal is missing, or one of them has no value.
        """
        for signal in (*inputs, output):
            if signal not in record.columns:
                raise InputError(f"{record.name}: holds no signal {signal!r}, only {', '.join(record.columns)}")
            if not np.isfinite(record.columns[signal]).any():
                raise UnfitRecordError(
                    f"{record.name}: {signal} has no measured value, so no model of {output} can be fitted"
                )
        columns = [record.columns[name] for name in inputs]
        u = np.column_stack(columns) if columns else np.empty((record.rows, 0))
        return cls.of(record.continuous_min, u, record.columns[output], tuple(inputs), output, "leave out")

    @property
    def rows(self) -> int:
        """Number of rows."""
        return len(self.time)

    @property
    def arrays(self) -> tuple[Array, Array, Array]:
        """Inputs, output and time, in the order in which models take them."""
        return self.inputs, self.output, self.time

    def split(self, row: int) -> tuple["Dataset", "Dataset"]:
        """The rows before a row, and the others."""
        parts = (slice(None, row), slice(row, None))
        first, second = (
            replace(self, time=self.time[part], inputs=self.inputs[part], output=self.output[part]) for part in parts
        )
        return first, second

    def check_movement(self) -> None:
        """Check that the output and every input change.

        Raises:
            InputError: a signal whose measured values are all equal, or that has none.
        """
        for name, values in zip((self.output_name, *self.input_names), (self.output.T[0], *self.inputs.T), strict=True):
            measured = values[np.isfinite(values)]
            if measured.size == 0:
                raise UnfitRecordError(f"{name} has no measured value in the rows to fit, so no model can be fitted")
            if np.ptp(measured) > 0.0:
                continue
            if name == self.output_name:
                raise UnfitRecordError(
                    f"output {name} is constant, {measured[0]:g} in all rows to fit: there is nothing to identify; "
                    "name another output, or a record in which it changes"
                )
            raise UnfitRecordError(
                f"input {name} never moves, {measured[0]:g} in all rows to fit: a constant input excites none of the "
                "orders; leave it out, or record rows in which it moves"
            )


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
) -> Rows:
    """Rows of a record that can be predicted from complete rows without a gap between them.

    Args:
        structure: structure of the model.
        inputs: shape (rows,) or (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows,) or (rows, 1), NaN where nothing was measured.
        time: shape (rows,), increasing, in any unit; None: gaps are not detected.

    Raises:
        InputError: shapes that don't fit, or times that don't increase.
    """
    u = as_columns(inputs, "inputs", structure.inputs)
    y = as_columns(outputs, "outputs", 1)
    if len(u) != len(y):
        raise InputError(f"inputs and outputs must have equally many rows, got {len(u)} and {len(y)}")
    position = np.flatnonzero(consecutive_rows(np.concatenate([u, y], axis=1), time) > structure.history)
    columns = [y[position - lag] for lag in range(1, structure.output_lags + 1)]
    delays, inputs = np.array(structure.delays, dtype=np.int64), np.arange(structure.inputs)
    columns += [u[position[:, None] - delays - lag, inputs] for lag in range(structure.input_lags)]
    if structure.offset:
        columns.append(np.ones((position.size, 1)))
    return Rows(np.concatenate(columns, axis=1), y[position], position)


def consecutive_rows(signals: NDArray[np.float64], time: ArrayLike | None = None) -> NDArray[np.int64]:
    """Number of complete rows without a gap up to and including each row; 0 for an incomplete one.

    Args:
        signals: shape (rows, signals), NaN where nothing was measured.
        time: shape (rows,), increasing; the period is the median interval, and one that differs by a quarter is a gap.
            Without it no gap is looked for.

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
        gap = np.abs(intervals - period) > 0.25 * period
        starts[1:] = np.where(gap & complete[1:], position[1:], starts[1:])
    return np.where(complete, position - np.maximum(np.maximum.accumulate(starts), 0) + 1, 0)


class RunPlan(NamedTuple):
    """Rows of a record that a simulation covers.

    Attributes:
        starts: rows at which the simulation restarts from the measured rows before, shape (rows,).
        running: rows that it covers, shape (rows,).
    """

    starts: NDArray[np.bool_]
    running: NDArray[np.bool_]

    @property
    def arrays(self) -> PlanArrays:
        """Both, for kernels: a class among their arguments would have to stay where it is for their cached code."""
        return self.starts, self.running


def plan_run(
    structure: Structure,
    inputs: NDArray[np.float64],
    outputs: NDArray[np.float64],
    time: ArrayLike | None = None,
) -> RunPlan:
    """Plan the simulation of a record.

    Args:
        structure: structure of the model.
        inputs: shape (rows, inputs), NaN where nothing was measured.
        outputs: shape (rows, 1), NaN where nothing was measured.
        time: shape (rows,); None: gaps are not detected.
    """
    return RunPlan(
        *_plan(
            structure.history,
            consecutive_rows(inputs, time),
            consecutive_rows(np.concatenate([inputs, outputs], axis=1), time),
            consecutive_rows(np.zeros((len(inputs), 1)), time) == 1,
        )
    )


@jit
def _plan(
    reach: int, driven: NDArray[np.int64], complete: NDArray[np.int64], after_gap: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Plan from the counts of consecutive rows with inputs (`driven`) and with all values (`complete`)."""
    rows = driven.size
    starts, running = np.zeros(rows, np.bool_), np.zeros(rows, np.bool_)
    for k in range(1, rows):
        # Row k needs the inputs of the rows before it, not its own.
        if after_gap[k] or driven[k - 1] < reach:
            continue
        starts[k] = not running[k - 1] and complete[k - 1] >= reach
        running[k] = running[k - 1] or starts[k]
    return starts, running


@dataclass(frozen=True, eq=False)
class ScaledRecord:
    """Scaled signals of a record, to which a model of a structure is fitted.

    Attributes:
        structure: terms of the model.
        scaling: scaling of the signals.
        u: scaled inputs, shape (rows, inputs), NaN where nothing was measured.
        y: scaled output, shape (rows, 1), NaN where nothing was measured.
        time: times of the rows, shape (rows,), increasing, in any unit; None: gaps are not detected.
    """

    structure: Structure
    scaling: Scaling
    u: Array
    y: Array
    time: ArrayLike | None = None

    @classmethod
    def of(cls, structure: Structure, inputs: ArrayLike, outputs: ArrayLike, time: ArrayLike | None = None) -> Self:
        """Scale a record; arguments as for `linear.fit_linear`.

        Raises:
            InputError: shapes that don't fit the structure, or an output whose measured values are all equal.
        """
        u = as_columns(inputs, "inputs", structure.inputs)
        y = as_columns(outputs, "outputs", 1)
        values = y[np.isfinite(y)]
        if values.size and np.ptp(values) == 0.0:
            raise UnfitRecordError(f"output 1 is constant, {values[0]:g} in all rows: there is nothing to identify")
        scaling = Scaling.of(u, y, centred=structure.offset)
        return cls(structure, scaling, scaling.inputs(u), scaling.outputs(y), time)

    @cached_property
    def plan(self) -> RunPlan:
        """Rows that a simulation covers."""
        return plan_run(self.structure, self.u, self.y, self.time)

    def rows(self) -> Rows:
        """Rows that can be predicted, see `rows_of`."""
        return rows_of(self.structure, self.u, self.y, self.time)

    def enough_rows(self) -> Rows:
        """Rows that can be predicted, enough of them to determine the parameters.

        Raises:
            InputError: there are fewer rows than parameters.
        """
        rows = self.rows()
        usable, parameters = rows.regressors.shape
        if usable < parameters:
            raise UnfitRecordError(
                f"{parameters} parameters need at least {parameters} rows that are complete and follow complete rows "
                f"without a gap, got {usable} of {len(self.y)}"
            )
        return rows
