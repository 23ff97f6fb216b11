"""Checks of the rows of a table: times in order and in range, possible values, runs."""

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.layout import Layout
from reactorwatch.records.record import LARGEST_VALUE, LONGEST_MIN
from reactorwatch.records.text_table import TextTable
from reactorwatch.records.time_column import MAX_SHARE_BACK, TimeColumn
from reactorwatch.records.times import Times, units_per_minute

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


def filled_rows(times: Times, columns: dict[str, NDArray[np.float64]]) -> NDArray[np.bool_] | None:
    """True for rows in which anything was measured; None: all, or the first one is empty."""
    if times.valid.all():
        return None
    filled = times.valid.copy()
    for values in columns.values():
        filled |= ~np.isnan(values)
    return filled


def check_times(
    table: TextTable,
    time: TimeColumn,
    times: Times,
    minutes: NDArray[np.float64],
    runs: NDArray[np.intp] | None,
    kept: NDArray[np.bool_] | None,
) -> None:
    """Check that each row has a time in the range of a record's, and another one than the row before.

    Raises:
        InputError: a row has not.
    """
    if not minutes.size or (kept is not None and not kept.any()):
        raise InputError(f"{table.layout.path}: expected rows below the header, got none")
    ends = np.abs(minutes[[0, -1]])
    if kept is None and (minutes[1:] > minutes[:-1]).all() and (ends <= LONGEST_MIN).all():
        return
    rows = np.arange(minutes.size) if kept is None else np.flatnonzero(kept)
    column = time.columns[0] if time.columns else 0
    still = np.diff(minutes[rows]) == 0
    if runs is not None:
        still &= np.diff(runs[rows]) == 0
    with np.errstate(invalid="ignore"):
        wrong = ~(np.abs(minutes[rows]) <= LONGEST_MIN)
    wrong[1:] |= still
    if not wrong.any():
        return
    at = int(np.flatnonzero(wrong)[0])
    row = int(rows[at])
    if times.valid[row] and not np.abs(minutes[row]) <= LONGEST_MIN:
        most = f"{LONGEST_MIN * units_per_minute(time.unit or 's'):.3g}"
        rule = f"expected a time within 146 years of its zero ({most} at most)"
        table.refuse(row, column, rule, "check its unit: seconds are time_s")
    if np.isinf(minutes[row]):
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
