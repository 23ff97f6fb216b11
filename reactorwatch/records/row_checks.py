"""Checks of the rows of a table: times in order and in range, possible values, runs."""

from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.layout import Layout
from reactorwatch.records.record import LARGEST_VALUE, LONGEST_MIN
from reactorwatch.records.text_table import TextTable
from reactorwatch.records.time_column import MAX_SHARE_BACK, TimeColumn
from reactorwatch.records.times import Times, units_per_minute

DUPLICATES, MERGED = "duplicate rows left out", "rows merged into a later one of the same time, whose values count"

LONGEST_NUMBER = 18
"""Most digits of a run's number."""


def numbered_runs(table: TextTable, column: int | None) -> NDArray[np.intp] | None:
    """Number of each row's run; None if the column does not count up from 1."""
    if column is None:
        return None
    cells = [cell.strip() for cell in table.texts(column).to_pylist()]
    if not all(cell.isdecimal() and len(cell) < LONGEST_NUMBER for cell in cells):
        return None
    runs = np.array([int(cell) for cell in cells], dtype=np.intp)
    steps = np.diff(runs, prepend=0)
    return runs if runs.size and runs[0] == 1 and np.all((steps == 0) | (steps == 1)) else None


def filled_rows(times: Times, columns: dict[str, NDArray[np.float64]]) -> NDArray[np.intp]:
    """Indices of the rows that have a time, or in which anything was measured."""
    filled = times.valid.copy()
    if not filled.all():
        for values in columns.values():
            filled |= ~np.isnan(values)
    return np.flatnonzero(filled)


def join_repeats(
    times: NDArray[Any],
    columns: dict[str, NDArray[np.float64]],
    runs: NDArray[np.intp] | None = None,
    most: float = 1.0,
) -> tuple[NDArray[np.intp], dict[str, NDArray[np.float64]], Counter[str]]:
    """Leave out copies of earlier rows, and join different rows of one time: the last value of each signal counts.

    Copies stand below their originals, or are a block that was written again, as where exports overlap. A step back in
    time with other values starts another run, and stays.

    Args:
        times: times of the rows, shape (rows,).
        columns: values by signal, each of shape (rows,).
        runs: number of each row's run, shape (rows,); None: one run.
        most: largest share of rows whose values may give way to those of a later one; with more, all stay.

    Returns:
        Indices of the rows that stay, their values, and the numbers of other rows by what became of them.
    """
    every = np.arange(times.size)
    if (times[1:] > times[:-1]).all():
        return every, columns, Counter()
    run = np.zeros_like(every) if runs is None else runs
    order = np.lexsort((every, times, run))
    one, other = order[:-1], order[1:]
    is_copy, back = np.zeros((2, times.size), dtype=bool)
    is_copy[other] = (times[one] == times[other]) & (run[one] == run[other])
    for values in columns.values():
        is_copy[other] &= (values[one] == values[other]) | (np.isnan(values[one]) & np.isnan(values[other]))
    for rows in np.split(every, np.flatnonzero(np.diff(run)) + 1):
        back[rows] = times[rows] < np.fmax.accumulate(times[rows])
    block = np.cumsum(np.diff(back, prepend=False))
    block_is_copy = np.bincount(block[~is_copy], minlength=block[-1] + 1) == 0
    rest = np.flatnonzero(~(back & block_is_copy[block]))
    index = np.arange(rest.size)
    same = np.zeros(rest.size, dtype=bool)
    same[1:] = (times[rest][1:] == times[rest][:-1]) & (run[rest][1:] == run[rest][:-1])
    first, stays = np.maximum.accumulate(np.where(same, 0, index)), ~np.append(same[1:], False)
    joined, loses = {}, np.zeros(rest.size, dtype=bool)
    for name, values in columns.items():
        own = values[rest]
        loses[1:] |= same[1:] & (own[1:] != own[:-1]) & ~np.isnan(own[1:] + own[:-1])
        last = np.maximum.accumulate(np.where(np.isnan(own), 0, index))
        joined[name] = own[np.maximum(last, first)][stays]
    if np.count_nonzero(loses) > most * times.size:
        return every, columns, Counter()
    merged = int(np.count_nonzero(same & ~is_copy[rest]))
    copies = times.size - int(np.count_nonzero(stays)) - merged
    return rest[stays], joined, +Counter({DUPLICATES: copies, MERGED: merged})


def check_times(
    table: TextTable,
    time: TimeColumn,
    times: Times,
    minutes: NDArray[np.float64],
    runs: NDArray[np.intp] | None,
    rows: NDArray[np.intp],
) -> None:
    """Check that each row has a time in the range of a record's, and another one than the row before.

    Raises:
        InputError: a row has not.
    """
    if not minutes.size:
        raise InputError(f"{table.layout.path}: expected rows below the header, got none")
    ends = np.abs(minutes[[0, -1]])
    if (minutes[1:] > minutes[:-1]).all() and (ends <= LONGEST_MIN).all():
        return
    column = time.columns[0] if time.columns else 0
    still = np.diff(minutes) == 0
    if runs is not None:
        still &= np.diff(runs) == 0
    with np.errstate(invalid="ignore"):
        wrong = ~(np.abs(minutes) <= LONGEST_MIN)
    wrong[1:] |= still
    if not wrong.any():
        return
    at = int(np.flatnonzero(wrong)[0])
    row = int(rows[at])
    if times.valid[row] and not np.abs(minutes[at]) <= LONGEST_MIN:
        most = f"{LONGEST_MIN * units_per_minute(time.unit or 's'):.3g}"
        rule = f"expected a time within 146 years of its zero ({most} at most)"
        table.refuse(row, column, rule, "check its unit: seconds are time_s")
    if np.isinf(minutes[at]):
        table.refuse(row, column, "expected a finite number")
    rule = "expected a time"
    if at:
        before = int(rows[at - 1])
        is_number = time.pattern is None
        text = repr(float(table.numbers(column)[before])) if is_number else str(table.texts(column)[before])
        rule += f" after {text}, that of the row before"
    is_clock = times.is_clock and times.valid[row]
    table.refuse(row, column, rule, "state --zone if summer time ends here" if is_clock else "")


def check_values(table: TextTable, column: int, values: NDArray[np.float64]) -> None:
    """Check that the values of a column are possible measurements.

    Raises:
        InputError: one is not.
    """
    if max(np.fmax.reduce(values, initial=0.0), -np.fmin.reduce(values, initial=0.0)) < LARGEST_VALUE:
        return
    row = int(np.flatnonzero(np.abs(values) >= LARGEST_VALUE)[0])
    if np.isinf(values[row]):
        table.refuse(row, column, "expected a finite number or nothing")
    rule = f"expected a number below {LARGEST_VALUE:g}, or nothing where nothing was measured"
    table.refuse(row, column, rule)


def find_runs(
    layout: Layout, time: TimeColumn, minutes: NDArray[np.float64], numbered: NDArray[np.intp] | None
) -> NDArray[np.intp] | None:
    """Number of each row's run, from 1; None for one run.

    Raises:
        InputError: the time steps back too often for rows in time order.
    """
    if numbered is None and (minutes[1:] >= minutes[:-1]).all():
        return None
    back = starts = np.diff(minutes, prepend=minutes[0]) < 0
    if numbered is not None:
        begins = np.diff(numbered, prepend=1) > 0
        back, starts = starts & ~begins, starts | begins
    if np.count_nonzero(back) > MAX_SHARE_BACK * minutes.size:
        name = layout.names[time.columns[0]]
        raise InputError(
            f"{layout.path}, column {name!r}: expected rows in time order, the time steps back before "
            f"{np.count_nonzero(back)} of {minutes.size} rows; sort the rows by time"
        )
    return 1 + np.cumsum(starts) if starts.any() else None
