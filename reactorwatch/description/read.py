"""Read measured data of a process from tables of any common form."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from reactorwatch.description.process import Process
from reactorwatch.errors import InputError
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.records.read_table import SignalColumn, read_table
from reactorwatch.records.record import Record
from reactorwatch.records.time_column import STANDARD
from reactorwatch.units import conversion


def read_process_table(
    path: Path, process: Process, columns: Mapping[str, str] | None = None, stated: FileFormat = GUESS
) -> Record:
    """Read the signals of a process from a table.

    Args:
        path: the file, see `read_table`.
        process: decides which signals are read, from which columns and in which units; its inputs and outputs must be
            there.
        columns: names of columns with other names, by signal, or by `time_min` or `time_s`. Such a column has the unit
            in brackets at its end, or an unknown one.
        stated: statements about the file, which override those of the process.

    Returns:
        The record, in the units of the equations; without equations, in those of the signals. A value outside the
        bounds of its signal is NaN, as if it was not measured; `read_as` has their number.

    Raises:
        InputError: as `read_table`; or `columns` names no signal of the process.
    """
    names, stated = dict(columns or {}), process.file_format.override(stated)
    for name, unit in STANDARD.items():
        if name in names:
            stated = replace(stated, time=names.pop(name), time_unit=unit)
    known = [signal.name for signal in process.signals]
    for name in names:
        if name not in known:
            valid = ", ".join((*STANDARD, *known))
            raise InputError(f"{path}: unknown column {name!r} asked for (valid: {valid})")
    signals = [
        SignalColumn(
            signal.name,
            unit="" if names.get(signal.name, signal.name) != signal.name else signal.unit,
            role=signal.role,
            column=names.get(signal.name, None if signal.column is None else str(signal.column)),
            required=signal.role in ("input", "output") or signal.name in names,
        )
        for signal in process.signals
    ]
    return _to_model_units(_drop_impossible(read_table(path, signals, stated), process), process)


def _drop_impossible(record: Record, process: Process) -> Record:
    """Replace values outside the bounds of their signals by NaN."""
    columns, notes = dict(record.columns), [record.read_as] if record.read_as else []
    for signal in process.signals:
        if signal.bounds is None or signal.name not in columns:
            continue
        low, high = signal.bounds
        values = columns[signal.name]
        outside = (values < low) | (values > high)
        if outside.any():
            columns[signal.name] = np.where(outside, np.nan, values)
            notes.append(f"{np.count_nonzero(outside)} values of {signal.name} outside {low:g} to {high:g} left out")
    return replace(record, columns=columns, read_as=", ".join(notes))


def _to_model_units(record: Record, process: Process) -> Record:
    """Convert signals of the equations to their units there."""
    columns, units = dict(record.columns), dict(record.units)
    for name, wanted in ({} if process.model is None else process.model.units).items():
        unit = units.get(name, wanted)
        if unit == wanted:
            continue
        scale, offset = conversion(unit, wanted, f"{record.name}, signal {name!r}")
        columns[name], units[name] = scale * columns[name] + offset, wanted
    return replace(record, columns=columns, units=units)
