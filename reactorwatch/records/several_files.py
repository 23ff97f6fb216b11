"""Files that follow each other as one record."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from reactorwatch.errors import InputError
from reactorwatch.records.record import MINUTE_NS, Record, join_runs
from reactorwatch.records.row_checks import join_repeats

EXCLUDED = "\0"
"""Begins the names of excluded values while rows are joined; no signal has it."""


def join_files(records: Sequence[Record]) -> Record:
    """Join records of files that follow each other.

    A file continues the last run of the file before it; if it starts before that run's end with other rows than those,
    it starts a new one.

    Raises:
        InputError: they have different signals or units, or not all have clock time.
    """
    first = records[0]
    if len(records) == 1:
        return first
    parts: list[Record] = []
    repeats: Counter[str] = Counter()
    for record in records:
        _check_alike(record, first)
        shift_min = (record.zero_ns - first.zero_ns) / MINUTE_NS
        for number, run in enumerate(record.split_runs()):
            part = replace(run, time_min=run.time_min + shift_min)
            if parts and not number:
                both = replace(join_runs([parts[-1], part]), runs=None)
                excluded = {EXCLUDED + name: values for name, values in both.excluded.items()}
                stay, columns, found = join_repeats(both.time_min, {**both.columns, **excluded})
                if (np.diff(both.time_min[stay]) > 0).all():
                    excluded = {name: columns.pop(EXCLUDED + name) for name in both.excluded}
                    part = replace(both, time_min=both.time_min[stay], columns=columns, excluded=excluded)
                    repeats += found
                    parts.pop()
            parts.append(part)
    strays = sum(record.strays for record in records)
    notes = dict.fromkeys(record.read_as for record in records if record.read_as)
    read_as = "; ".join([*notes, *(f"{text}: {count}" for text, count in repeats.items())])
    return replace(join_runs(parts), zero_ns=first.zero_ns, first_row=None, strays=strays, read_as=read_as)


def _check_alike(record: Record, first: Record) -> None:
    if record.columns.keys() != first.columns.keys():
        got, expected = ", ".join(record.columns), ", ".join(first.columns)
        raise InputError(f"{record.name}: expected the signals of {first.name}, {expected}, got {got}")
    if dict(record.units) != dict(first.units):
        raise InputError(f"{record.name}: expected the units of {first.name}, {first.units}, got {record.units}")
    if bool(record.zero_ns) != bool(first.zero_ns):
        raise InputError(f"{record.name}: expected {'' if first.zero_ns else 'no '}clock time, as {first.name} has")
