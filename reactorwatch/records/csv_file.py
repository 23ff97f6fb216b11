"""The reactor's records as CSV: read from a file of any form, and written.

The columns are `time_min` or `time_s` or another that is recognised as the time, then `qc`, `C`, `T` in any order among
others, which are ignored. Gaps and irregular times are allowed; an empty cell was not measured. A step back in time
starts a new run; in a column `run` that counts up from 1 by 1, each number is a run.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.records.read_table import SignalColumn, read_table
from reactorwatch.records.record import UNITS, Record
from reactorwatch.records.time_column import STANDARD
from reactorwatch.records.write_table import write_table


def read_csv(
    path: Path,
    columns: Mapping[str, str] | None = None,
    required: tuple[str, ...] = tuple(UNITS),
    units: Mapping[str, str] = UNITS,
    stated: FileFormat = GUESS,
) -> Record:
    """Read a record.

    Args:
        path: the file, see `read_table`.
        columns: the file's names of columns with other names: `{"T": "reactor_temp", "time_s": "t"}`.
        required: signals that must have a column; the reactor's others are read if they have one.
        units: units of the process's signals. A column with the signal's name has this unit; one with another name has
            the unit in brackets at its end, or an unknown one.
        stated: statements about the file that override the guesses.

    Returns:
        The record; an empty cell is NaN.

    Raises:
        InputError: the file cannot be read or is malformed; one line with file, row (as a text editor counts it),
            column, the expected and the actual content.
    """
    wanted = tuple(dict.fromkeys((*UNITS, *required)))
    names = columns or {}
    for name in names:
        if name not in (*STANDARD, *wanted):
            valid = ", ".join((*STANDARD, *wanted))
            raise InputError(f"{path}: unknown column {name!r} asked for (valid: {valid})")
    for name, unit in STANDARD.items():
        if name in names:
            stated = replace(stated, time=names[name], time_unit=unit)
            break
    signals = [
        SignalColumn(
            signal,
            unit="" if names.get(signal, signal) != signal else units.get(signal, ""),
            column=names.get(signal),
            required=signal in required or signal in names,
        )
        for signal in wanted
    ]
    return read_table(path, signals, stated)


def write_csv(path: Path, record: Record) -> None:
    """Write a record so that `read_csv` returns exactly the same numbers; see `write_table`."""
    write_table(path, record)
