"""Files that follow each other as one record."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from reactorwatch.errors import InputError
from reactorwatch.records.file_format import GUESS, FileFormat
from reactorwatch.records.read_table import SignalColumn, read_table
from reactorwatch.records.record import MINUTE_NS, Record, join_runs


def read_tables(
    paths: Sequence[Path], signals: Sequence[SignalColumn] | None = None, stated: FileFormat = GUESS
) -> Record:
    """Read several files in a row as one record; one that starts before the end of the one before is a new run.

    Raises:
        InputError: as `read_table`; or the files have different signals.
    """
    return join_files([read_table(path, signals, stated) for path in paths])


def join_files(records: Sequence[Record]) -> Record:
    """Join records of files that follow each other.

    Raises:
        InputError: they have different signals, or not all have clock time.
    """
    first = records[0]
    if len(records) == 1:
        return first
    parts: list[Record] = []
    for record in records:
        if record.columns.keys() != first.columns.keys():
            got, expected = ", ".join(record.columns), ", ".join(first.columns)
            raise InputError(f"{record.name}: expected the signals of {first.name}, {expected}, got {got}")
        if bool(record.zero_ns) != bool(first.zero_ns):
            raise InputError(f"{record.name}: expected {'' if first.zero_ns else 'no '}clock time, as {first.name} has")
        shift = (record.zero_ns - first.zero_ns) / MINUTE_NS
        for run in record.split_runs():
            moved = Record(run.time_min + shift, run.columns, first.name, first.zero_ns, units=first.units)
            if parts and run is not record.split_runs()[0]:
                parts.append(moved)
            elif parts and parts[-1].time_min[-1] < moved.time_min[0]:
                last = parts.pop()
                columns = {name: np.concatenate([values, moved.columns[name]]) for name, values in last.columns.items()}
                times = np.concatenate([last.time_min, moved.time_min])
                parts.append(Record(times, columns, first.name, first.zero_ns, units=first.units))
            else:
                parts.append(moved)
    joined = join_runs(parts)
    return Record(
        joined.time_min,
        joined.columns,
        first.name,
        first.zero_ns,
        runs=joined.runs,
        units=first.units,
        strays=sum(record.strays for record in records),
        read_as=first.read_as,
    )
