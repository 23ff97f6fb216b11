"""Records as CSV: from a plant's historian, a spreadsheet, another program, or `export`.

The header names the columns: `time_min` or `time_s`, then `qc`, `C`, `T` in any order among others, which are ignored.
Rows are in time order; gaps and irregular times are allowed; an empty cell was not measured. A step back in time starts
a new run; in a column `run` that counts up from 1 by 1, each number is a run.

NumPy parses a well-formed file at once. Any other file is parsed again row by row, which is slow, accepts a few more
forms (quoted numbers, for instance), and otherwise finds the row and the column for the message.
"""

import csv
import io
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.input_file import wrap_read_errors
from reactorwatch.records.record import LARGEST_VALUE, LONGEST_MIN, UNITS, Record

LONGEST_NUMBER = 18
"""Most digits of a run's number."""

_MINUTES_PER_UNIT = {"time_min": 1.0, "time_s": 60.0}  # divided by, so that 7 s is the same 7/60 min everywhere
RUN = "run"
"""Column with the run of each row, if a record has several."""

MAX_SHARE_BACK = 1 / 3
"""Largest share of rows with a step back in time; a file with more is not in time order."""

_BRACKETED = re.compile(r"[\[(]([^\[\]()]+)[\])]\s*$")
_MCAP_MAGIC = b"\x89MCAP"


class _Column(NamedTuple):
    name: str  # as in the file
    position: int


class _Layout(NamedTuple):
    """Columns of a file; `runs` is the number of each row's run, if there is such a column."""

    width: int
    header_lines: int
    time: _Column
    units_per_minute: float
    signals: dict[str, _Column]
    runs: NDArray[np.intp] | None


def read_csv(
    path: Path,
    columns: Mapping[str, str] | None = None,
    required: tuple[str, ...] = tuple(UNITS),
    units: Mapping[str, str] = UNITS,
) -> Record:
    """Read a record.

    Args:
        path: the file: UTF-8, comma separated.
        columns: the file's names of columns with other names: `{"T": "reactor_temp", "time_s": "t"}`.
        required: signals that must have a column; the reactor's others are read if they have one.
        units: units of the process's signals. A column with the signal's name has this unit; one with another name has
            the unit in brackets at its end, or an unknown one.

    Returns:
        The record; an empty cell is NaN.

    Raises:
        InputError: the file cannot be read or is malformed; one line with file, row (as a text editor counts it),
            column, the expected and the actual content.
    """
    text = _text(path)
    layout = _layout(path, text, columns or {}, required)
    values = _parse_fast(text, layout)
    if values is None:
        values = _parse_rows(path, text, layout)
    time_min = values[:, 0] / layout.units_per_minute
    signals = {signal: values[:, number].copy() for number, signal in enumerate(layout.signals, start=1)}
    known = {signal: _unit(signal, column.name, units) for signal, column in layout.signals.items()}
    known = {name: unit for name, unit in known.items() if unit}
    lines_below_header = text.rstrip("\n").count("\n") + 1 - layout.header_lines
    first_row = layout.header_lines + 1 if lines_below_header == len(values) else None  # None: blank lines between
    runs = _runs(path, layout, values[:, 0])
    return Record(time_min, signals, path.name, first_row=first_row, runs=runs, units=known)


def _unit(signal: str, column: str, units: Mapping[str, str]) -> str:
    """Unit of a signal in a column; empty: unknown."""
    if column == signal:
        return units.get(signal, "")
    bracketed = _BRACKETED.search(column)
    return bracketed[1].strip() if bracketed else ""


def write_csv(path: Path, record: Record) -> None:
    """Write a record so that `read_csv` returns exactly the same numbers.

    Raises:
        InputError: the folder does not exist or cannot be written to.
        ValueError: a time or a value that `read_csv` refuses, such as an infinite one.
    """
    if not _is_valid_time(record.time_min, 1.0).all():
        raise ValueError(f"times must be within {LONGEST_MIN:.3g} min of their zero to be read again from CSV")
    cells = [record.time_min.tolist()]
    header = ["time_min", *record.columns]
    for signal, values in record.columns.items():
        if (np.abs(values) >= LARGEST_VALUE).any():
            raise ValueError(
                f"column {signal!r} must be below {LARGEST_VALUE:g} or NaN to be read again from CSV, "
                f"got {np.nanmax(np.abs(values)):g}"
            )
        cells.append(["" if math.isnan(value) else value for value in values.tolist()])
    if record.runs is not None:
        header.append(RUN)
        cells.append(record.runs.tolist())
    with atomic_write(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")  # writes a float as its repr, which reads back exactly
        writer.writerow(header)
        writer.writerows(zip(*cells, strict=True))


def _text(path: Path) -> str:
    with wrap_read_errors(path):
        try:
            data = path.read_bytes()
        except IsADirectoryError as error:
            raise InputError(f"{path}: expected a CSV file, got a folder") from error
    if data.startswith(_MCAP_MAGIC):
        raise InputError(f"{path}: expected a CSV file, got an MCAP recording; give it the ending .mcap")
    if b"\0" in data:
        raise InputError(f"{path}: expected a CSV file, got binary data")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        row = data.count(b"\n", 0, error.start) + 1
        byte = f"byte 0x{data[error.start]:02x}"
        raise InputError(f"{path}, row {row}: expected UTF-8 text, got {byte}; save it as 'CSV UTF-8'") from error
    if not text or text.isspace():
        raise InputError(f"{path}: expected a header and rows, got an empty file")
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    return text


def _layout(path: Path, text: str, columns: Mapping[str, str], required: tuple[str, ...]) -> _Layout:
    wanted = tuple(dict.fromkeys((*UNITS, *required)))
    known = (*_MINUTES_PER_UNIT, *wanted)
    for name in columns:
        if name not in known:
            raise InputError(f"{path}: unknown column {name!r} asked for (valid: {', '.join(known)})")
    row, cells = next(_rows(path, text), (1, []))
    header = [cell.strip() for cell in cells]
    for name in header:
        if name and header.count(name) > 1:
            raise InputError(f"{path}, row {row}: expected each column name once, got {name!r} more than once")
    found = f"got {', '.join(map(repr, header))}"
    if len(header) == 1:
        found += "; the cells must be separated by commas"

    def column(name: str) -> _Column | None:
        in_file = columns.get(name, name)
        return _Column(in_file, header.index(in_file)) if in_file in header else None

    times = [(at, per_minute) for name, per_minute in _MINUTES_PER_UNIT.items() if (at := column(name))]
    if not times:
        asked = " or ".join(repr(columns.get(name, name)) for name in _MINUTES_PER_UNIT)
        raise InputError(f"{path}, row {row}: expected a column {asked} in the header, {found}")
    signals = {signal: at for signal in wanted if (at := column(signal))}
    for signal in required:
        if signal not in signals:
            asked = repr(columns.get(signal, signal))
            raise InputError(f"{path}, row {row}: expected a column {asked} in the header, {found}")
    for signal, in_file in columns.items():
        if in_file not in header:
            raise InputError(f"{path}, row {row}: expected a column {in_file!r} (for {signal}) in the header, {found}")
    time, units_per_minute = times[0]
    runs = _run_column(path, text, header.index(RUN)) if RUN in header and RUN not in columns.values() else None
    return _Layout(len(header), row, time, units_per_minute, signals, runs)


def _run_column(path: Path, text: str, position: int) -> NDArray[np.intp] | None:
    """Number of each row's run; None if the column does not count up from 1."""
    rows = _rows(path, text)
    next(rows)  # the header
    cells = [cells[position].strip() if position < len(cells) else "" for _, cells in rows]
    if not all(cell.isdecimal() and len(cell) < LONGEST_NUMBER for cell in cells):
        return None
    runs = np.array([int(cell) for cell in cells], dtype=np.intp)
    steps = np.diff(runs, prepend=0)
    return runs if runs.size and runs[0] == 1 and np.all((steps == 0) | (steps == 1)) else None


def _runs(path: Path, layout: _Layout, times: NDArray[np.float64]) -> NDArray[np.intp] | None:
    """Number of each row's run, from 1; None for one run.

    Raises:
        InputError: the time steps back too often for rows in time order.
    """
    starts = np.diff(times, prepend=times[0]) < 0
    if layout.runs is not None:
        numbered = np.diff(layout.runs, prepend=1) > 0
        back, starts = starts & ~numbered, starts | numbered
    else:
        back = starts
    if np.count_nonzero(back) > MAX_SHARE_BACK * times.size:
        raise InputError(
            f"{path}, column {layout.time.name!r}: expected rows in time order, the time steps back before "
            f"{np.count_nonzero(back)} of {times.size} rows; sort the rows by time"
        )
    return 1 + np.cumsum(starts) if starts.any() else None


def _parse_fast(text: str, layout: _Layout) -> NDArray[np.float64] | None:
    """Parse with NumPy, shape (rows, 1 + signals); None if anything is unusual."""
    body = "".join(text.split("\n", layout.header_lines)[layout.header_lines :])
    if not body or body.isspace():
        return None
    commas = body.count(",")
    for hole, filled in ((",,", ",nan,"), (",,", ",nan,"), (",\n", ",nan\n")):
        body = body.replace(hole, filled)
    if body.endswith(","):
        body += "nan"
    used = (layout.time.position, *(column.position for column in layout.signals.values()))
    try:
        values = np.loadtxt(body.split("\n"), delimiter=",", comments=None, usecols=used, ndmin=2)
    except ValueError:
        return None
    regular = commas == len(values) * (layout.width - 1)
    times = values[:, 0]
    possible = np.abs(values[:, 1:]).max(initial=0.0, where=~np.isnan(values[:, 1:])) < LARGEST_VALUE
    still = np.diff(times) == 0
    if layout.runs is not None and layout.runs.size == times.size:
        still &= np.diff(layout.runs) == 0
    if not (regular and possible and _is_valid_time(times, layout.units_per_minute).all() and not still.any()):
        return None
    return values


def _parse_rows(path: Path, text: str, layout: _Layout) -> NDArray[np.float64]:
    """Parse row by row, shape (rows, 1 + signals)."""
    rows = _rows(path, text)
    next(rows)  # the header
    parsed: list[list[float]] = []
    columns = (layout.time, *layout.signals.values())
    previous, runs = math.nan, layout.runs
    for row, cells in rows:
        if len(cells) != layout.width:
            raise InputError(f"{path}, row {row}: expected {layout.width} cells as in the header, got {len(cells)}")
        values = [_number(cells[column.position]) for column in columns]
        for column, value in zip(columns, values, strict=True):
            if value is not None and column is not layout.time and abs(value) >= LARGEST_VALUE:
                raise InputError(
                    f"{path}, row {row}, column {column.name!r}: expected a number below {LARGEST_VALUE:g}, or nothing "
                    f"where nothing was measured, got {cells[column.position]!r}"
                )
            if value is None:
                raise InputError(
                    f"{path}, row {row}, column {column.name!r}: expected a finite number"
                    f"{'' if column is layout.time else ' or nothing'}, got {cells[column.position]!r}"
                )
        time = cast(float, values[0])
        same_run = runs is None or not parsed or runs[len(parsed)] == runs[len(parsed) - 1]
        if math.isnan(time) or (time == previous and same_run):
            after = "" if not parsed else f" after {previous!r}, that of the row before"
            found = cells[layout.time.position]
            raise InputError(f"{path}, row {row}, column {layout.time.name!r}: expected a time{after}, got {found!r}")
        if not _is_valid_time(np.array(time), layout.units_per_minute):
            most = f"{LONGEST_MIN * layout.units_per_minute:.3g}"
            raise InputError(
                f"{path}, row {row}, column {layout.time.name!r}: expected a time within 146 years of its zero "
                f"({most} at most), got {cells[layout.time.position]!r}; check its unit: seconds are time_s"
            )
        previous = time
        parsed.append(cast(list[float], values))
    if not parsed:
        raise InputError(f"{path}: expected rows below the header, got none")
    return np.array(parsed)


def _is_valid_time(times: NDArray[np.float64], units_per_minute: float) -> NDArray[np.bool_]:
    """True for each time in the range of a record's."""
    with np.errstate(over="ignore"):
        return np.asarray(np.abs(times) <= LONGEST_MIN * units_per_minute)


def _number(cell: str) -> float | None:
    """Finite number in a cell; NaN if it is empty, None if it holds anything else."""
    text = cell.strip()
    if not text:
        return math.nan
    if "_" in text:  # Python's own 1_000
        return None
    try:
        number = float(text)
    except ValueError:
        return None
    return None if math.isinf(number) else number


def _rows(path: Path, text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield rows that are not blank, each with the number of its last line."""
    reader = csv.reader(io.StringIO(text), strict=True)
    while True:
        try:
            cells = next(reader, None)
        except csv.Error as error:
            raise InputError(f"{path}, row {reader.line_num}: expected comma separated cells: {error}") from error
        if cells is None:
            return
        if cells and (len(cells) > 1 or cells[0].strip()):
            yield reader.line_num, cells
