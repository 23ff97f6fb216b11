"""Rows of one output and of the inputs that act on it, checked before any model is fitted."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.identification.structure import as_columns
from reactorwatch.records.record import Record


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
