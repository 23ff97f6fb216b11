"""Values that a signal cannot have: cells that stand for "not measured", such as -999, 9999 or 65535.

A filter would take such a value for the plant. An input beyond its bounds cannot be simulated at all; an output may
exceed those of its state by a scale, for noise and offsets of its sensor.
"""

import numpy as np

from reactorwatch.errors import InputError
from reactorwatch.process.model import Array, ProcessModel, Variable
from reactorwatch.records.record import Record

MARGIN = 1.0
"""In scales of a state: its sensor may show values so far beyond its bounds."""


def typical_value(values: Array) -> float:
    """Median of the different values of a signal, so that a value which stands for "not measured" counts once."""
    return float(np.median(np.unique(values[np.isfinite(values)])))


def check_values(record: Record, model: ProcessModel) -> None:
    """Refuse a record in which a signal of the model has a value that it cannot have; missing columns are passed over.

    Raises:
        InputError: the first such value, by file, row and column.
    """
    states = {state.name: (state, MARGIN * state.scale) for state in model.states}
    bounds = {item.name: (item, 0.0) for item in model.inputs}
    bounds |= {name: states[name] for name in model.output_names if name in states}
    for name, (item, margin) in bounds.items():
        if name in record.columns:
            _check_column(record, name, item, margin)


def _check_column(record: Record, name: str, item: Variable, margin: float) -> None:
    values, lower, upper = record.columns[name], item.lower - margin, item.upper + margin
    rows = np.flatnonzero(np.isfinite(values) & ~((values >= lower) & (values <= upper)))
    if not rows.size:
        return
    row = int(rows[0])
    others = np.count_nonzero(values[rows] == values[row]) - 1
    also = f" (and {others} more of it)" if others else ""
    raise InputError(
        f"{_place(record, row)}, column {name!r}: must be in [{lower:g}, {upper:g}] {item.unit}, "
        f"got {values[row]:g}{also}; empty the cells that mean 'not measured'"
    )


def _place(record: Record, row: int) -> str:
    at = f"{record.time_min[row]:g} min"
    if record.first_row is None:  # of a recording
        return f"{record.name}, at {at}"
    return f"{record.name}, row {record.first_row + row} ({at})"
