"""Files that follow each other as one record."""

from collections.abc import Sequence
from dataclasses import replace

from reactorwatch.errors import InputError
from reactorwatch.records.record import MINUTE_NS, Record, join_runs


def join_files(records: Sequence[Record]) -> Record:
    """Join records of files that follow each other.

    A file continues the last run of the file before it; if it starts before that run's end, it starts a new one.

    Raises:
        InputError: they have different signals or units, or not all have clock time.
    """
    first = records[0]
    if len(records) == 1:
        return first
    parts: list[Record] = []
    for record in records:
        _check_alike(record, first)
        shift_min = (record.zero_ns - first.zero_ns) / MINUTE_NS
        for number, run in enumerate(record.split_runs()):
            part = replace(run, time_min=run.time_min + shift_min)
            if parts and not number and parts[-1].time_min[-1] < part.time_min[0]:
                part = replace(join_runs([parts.pop(), part]), runs=None)
            parts.append(part)
    strays = sum(record.strays for record in records)
    return replace(join_runs(parts), zero_ns=first.zero_ns, first_row=None, strays=strays, read_as=first.read_as)


def _check_alike(record: Record, first: Record) -> None:
    if record.columns.keys() != first.columns.keys():
        got, expected = ", ".join(record.columns), ", ".join(first.columns)
        raise InputError(f"{record.name}: expected the signals of {first.name}, {expected}, got {got}")
    if dict(record.units) != dict(first.units):
        raise InputError(f"{record.name}: expected the units of {first.name}, {first.units}, got {record.units}")
    if bool(record.zero_ns) != bool(first.zero_ns):
        raise InputError(f"{record.name}: expected {'' if first.zero_ns else 'no '}clock time, as {first.name} has")
