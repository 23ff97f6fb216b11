"""Read measured data of a process from tables of any common form."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.description.find import DEFAULT_PROCESS, ProcessChoice
from reactorwatch.description.process import Process
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.records.read import MissingColumnError, SignalColumn, read_table
from reactorwatch.records.record import LARGEST_VALUE, Record
from reactorwatch.records.times import STANDARD
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
        bounds of its signal is NaN, as if it was not measured; `excluded` has it, and `read_as` their number.

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
            valid = (*STANDARD, *known)
            raise InputError(f"{path}: --column SIGNAL=NAME: {describe_unknown('signal', name, valid)}")
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
    try:
        measured = read_table(path, signals, stated)
    except MissingColumnError as error:
        if process.name != DEFAULT_PROCESS:
            raise
        cure = "name its process with --process"
        if process.model is None:
            cure += ", or its columns with --input and --output"
        raise InputError(f"{error}; if it is no record of the reactor, {cure}") from error
    return _to_model_units(_exclude_impossible(measured, process), process)


def read_signals(
    path: Path, choice: ProcessChoice, columns: Mapping[str, str] | None = None, stated: FileFormat = GUESS
) -> Record:
    """Read the signals of a chosen process from a table, in the units of the signals, for use without equations.

    Args:
        path: see `read_process_table`.
        choice: the process.
        columns: see `read_process_table`.
        stated: see `read_process_table`.

    Raises:
        InputError: as `read_process_table`.
    """
    return read_process_table(path, choice.load().without_equations(), columns, stated)


def convert_to_process(record: Record, process: Process) -> Record:
    """Convert recorded signals to the units of a process, and exclude values outside their bounds.

    Args:
        record: samples in the units that they were published in; one without a unit is in that of its signal.
        process: decides the units: those of the equations, else those of the signals.

    Raises:
        InputError: a unit is one of another quantity.
    """
    known = {name: unit for name, unit in process.units.items() if name in record.columns}
    described = replace(record, units={**known, **record.units})
    return _to_model_units(_exclude_impossible(_convert(described, known), process), process)


def _exclude_impossible(record: Record, process: Process) -> Record:
    """Exclude values outside the bounds of their signals.

    Those of an input or output remain samples, since a monitor checks their range.
    """
    columns, excluded = record.raw_columns, dict[str, Array]()
    notes = [record.read_as] if record.read_as else []
    for signal in process.signals:
        if signal.bounds is None or signal.name not in columns:
            continue
        low, high = signal.bounds
        values = columns[signal.name]
        outside = (values < low) | (values > high)
        if outside.any():
            columns[signal.name] = np.where(outside, np.nan, values)
            if signal.role in ("input", "output"):
                excluded[signal.name] = np.where(outside & (np.abs(values) < LARGEST_VALUE), values, np.nan)
            counted = f"{np.count_nonzero(outside)} values of {signal.name} outside {low:g} to {high:g}"
            notes.append(f"{counted} are no measurements")
    return replace(record, columns=columns, read_as=", ".join(notes), excluded=excluded)


def _to_model_units(record: Record, process: Process) -> Record:
    """Convert signals of the equations to their units there."""
    return record if process.model is None else _convert(record, process.model.units)


def _convert(record: Record, wanted_units: Mapping[str, str]) -> Record:
    """Convert signals to units, by name of the signal."""
    columns, units, excluded = dict(record.columns), dict(record.units), dict(record.excluded)
    for name, wanted in wanted_units.items():
        unit = units.get(name, wanted)
        if unit == wanted or name not in columns:
            continue
        scale, offset = conversion(unit, wanted, f"{record.name}, signal {name!r}")
        columns[name], units[name] = scale * columns[name] + offset, wanted
        if name in excluded:
            excluded[name] = scale * excluded[name] + offset
    return replace(record, columns=columns, units=units, excluded=excluded)
