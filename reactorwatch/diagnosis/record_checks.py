"""Convert a record to a run of a model, and check that it can be diagnosed."""

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.impossible_values import check_values
from reactorwatch.diagnosis.run import Run
from reactorwatch.diagnosis.units import find_wrong_unit
from reactorwatch.errors import InputError, UnfitRecordError
from reactorwatch.process.model import ProcessModel
from reactorwatch.records.record import Record

FEWEST_ROWS = 200
FEWEST_VALUES = 100
"""Minimum number of values of an output."""

LEAST_MOVE = 1e-3
"""Minimum movement of an input, in its scales."""

FEW_ROWS = 10
"""The filter bridges up to this many missing rows, and restarts after more."""

_OFF_GRID, _REGULAR = 0.05, 0.95
"""Tolerance of steps that are whole periods, and the fraction of steps that must be, for rows on a grid."""


def make_run(record: Record, model: ProcessModel) -> Run:
    """Convert a record to a run of the model.

    Missing inputs keep their last value. Times of a record with several runs are `continuous_min`.

    Raises:
        InputError: too few rows; a signal that is missing, constant or in another unit; an impossible value.
    """
    name = record.name
    if record.rows < FEWEST_ROWS:
        raise UnfitRecordError(
            f"{name}: a diagnosis needs at least {FEWEST_ROWS} rows, got {record.rows}; record for longer"
        )
    missing = [item for item in (*model.input_names, *model.output_names) if item not in record.columns]
    if missing:
        raise InputError(
            f"{name}: needs the columns {', '.join((*model.input_names, *model.output_names))}, "
            f"{', '.join(missing)} is not there"
        )
    outputs = []
    for output in model.outputs:
        values = record.columns[output.name]
        finite = values[np.isfinite(values)]
        if finite.size < FEWEST_VALUES:
            raise UnfitRecordError(
                f"{name}: {output.name} needs at least {FEWEST_VALUES} values, got {finite.size}; "
                "is the column the right one, and is the sensor recorded?"
            )
        if np.ptp(finite) == 0.0:
            raise UnfitRecordError(
                f"{name}: {output.name} must vary, it is {finite[0]:g} {output.unit} in every row; "
                "the sensor is stuck, or the column is not what it seems"
            )
        outputs.append(values)
    inputs = []
    for item in model.inputs:
        values = np.concatenate([_hold_last(part.columns[item.name]) for part in record.split_runs()])
        if not np.all(np.isfinite(values)):
            of_run = "the first row" if record.runs is None else "the first row of each run"
            raise UnfitRecordError(
                f"{name}: {item.name} must be there in {of_run}; leave out the rows before its first value"
            )
        inputs.append(values)
    wrong = find_wrong_unit(model, record.columns, record.continuous_min)
    if wrong is not None and not wrong.of_times:
        raise InputError(f"{name}: {wrong.text}")
    check_values(record, model)
    if all(np.ptp(values) <= LEAST_MOVE * item.scale for values, item in zip(inputs, model.inputs, strict=True)):
        raise UnfitRecordError(
            f"{name}: {', '.join(model.input_names)} must move, it is {inputs[0][0]:g} all the time; "
            "causes cannot be distinguished without excitation: record an interval with steps in it"
        )
    if wrong is not None:
        raise InputError(f"{name}: {wrong.text}")
    there: NDArray[np.bool_] = np.column_stack([np.isfinite(record.columns[item.name]) for item in model.inputs])
    u = np.column_stack(inputs)
    time_min, starts = record.continuous_min, record.run_starts[1:]
    breaks, few = _breaks(time_min, u, there)
    return Run(time_min, u, np.column_stack(outputs), tuple(sorted({*breaks, *starts})), few, starts)


def _breaks(
    time_min: Array, inputs: Array, finite: NDArray[np.bool_]
) -> tuple[tuple[int, ...], NDArray[np.intp] | None]:
    """Rows after too long a gap in which the inputs changed at an unknown time; of the other gaps, `Run.missing`.

    In a record with irregular rows none counts as missing.
    """
    step = np.diff(time_min)
    period = float(np.median(step))
    counts = step / period
    regular = np.mean(np.abs(counts - np.round(counts)) < _OFF_GRID) > _REGULAR
    changed = np.any(np.diff(inputs, axis=0) != 0.0, axis=1)
    missing = np.round(counts).astype(np.intp) - 1
    short = changed & regular & (missing > 0) & (missing <= FEW_ROWS) & np.all(finite[:-1], axis=1)
    long = changed & ((counts > 1.5) & regular | ~np.all(finite[:-1], axis=1)) & ~short
    few = np.append(0, np.where(short, missing, 0))
    return tuple((np.flatnonzero(long) + 1).tolist()), few if np.any(short) else None


def _hold_last(values: Array) -> Array:
    """Replace missing values by the last value before them."""
    places = np.where(np.isfinite(values), np.arange(values.size), -1)
    places = np.maximum.accumulate(places)
    return np.where(places >= 0, values[np.maximum(places, 0)], np.nan)
