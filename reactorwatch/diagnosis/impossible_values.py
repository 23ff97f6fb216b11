"""Values that a signal cannot have: placeholders for "not measured", such as -999, 9999 or 65535.

A filter would take such a value for the plant. An input beyond its bounds cannot be simulated; an output may exceed the
bounds of its state by a scale, for noise and offset of its sensor.
"""

from typing import NamedTuple

import numpy as np

from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record

MARGIN = 1.0
"""Threshold in scales of a state: its sensor may exceed the bounds by this."""


class Bounds(NamedTuple):
    """Lowest and highest possible value of a signal, in its unit."""

    lower: float
    upper: float
    unit: str


def bounds_of(model: ProcessModel) -> dict[str, Bounds]:
    """Bounds of the inputs, and of the outputs that are states, by name."""
    margins = {state.name: (state, MARGIN * state.scale) for state in model.states if state.name in model.output_names}
    margins |= {item.name: (item, 0.0) for item in model.inputs}
    return {
        name: Bounds(item.lower - margin, item.upper + margin, item.unit) for name, (item, margin) in margins.items()
    }


def check_values(record: Record, model: ProcessModel) -> None:
    """Check that a record has no impossible values; missing columns are skipped.

    Raises:
        InputError: the first such value, by file, row and column.
    """
    for name, bounds in bounds_of(model).items():
        if name in record.columns:
            _check_column(record, name, bounds)


def _check_column(record: Record, name: str, bounds: Bounds) -> None:
    values, (lower, upper, unit) = record.columns[name], bounds
    rows = np.flatnonzero(np.isfinite(values) & ~((values >= lower) & (values <= upper)))
    if not rows.size:
        return
    row = int(rows[0])
    others = np.count_nonzero(values[rows] == values[row]) - 1
    also = f" (and {others} more of it)" if others else ""
    read_as = f"; read as: {record.read_as}" if "--missing" in record.read_as else ""  # a code, in the file's unit
    raise InputError(
        f"{_place(record, row)}, column {name!r}: must be in [{lower:g}, {upper:g}] {unit}, "
        f"got {values[row]:g}{also}; empty the cells that mean 'not measured'{read_as}"
    )


def _place(record: Record, row: int) -> str:
    at = f"{record.time_min[row]:g} min"
    if record.first_row is None:  # of a recording
        return f"{record.name}, at {at}"
    return f"{record.name}, row {record.first_row + row} ({at})"
