"""The time column of a table, chosen by name and content."""

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.cells import NUMBER, TIME
from reactorwatch.records.file_format import SECONDS, FileFormat
from reactorwatch.records.layout import Layout, bare_name
from reactorwatch.records.timestamps import CLOCK, PATTERNS, Pattern, guess_pattern, stated_pattern

STANDARD = {"time_min": "min", "time_s": "s"}
"""Names of time columns that need no guess, and their units."""

MAX_SHARE_BACK = 1 / 3
"""Largest share of rows with a step back in time; a file with more is not in time order."""

_TIME_NAMES = """
time zeit t ts tstamp timestamp datetime date datum uhrzeit zeitstempel zeitpunkt elapsed epoch unix clock temps heure
horodatage fecha hora tiempo tempo seconds minutes hours sekunden minuten stunden x_value"""
_INDEX_NAMES = "index idx sample samples row rows nr no n i k step steps id # zeile schritt"
_TIME_WORDS, _INDEX_WORDS = frozenset(_TIME_NAMES.split()), frozenset(_INDEX_NAMES.split())
_UNIT_WORDS = (
    "ns",
    "us µs",
    "ms msec millis milliseconds",
    "s sec secs second seconds sek sekunden",
    "min mins minute minutes minuten",
    "h hr hrs hour hours std stunden",
    "d day days tage",
)
_UNIT_OF = {word: words.split()[0] for words in _UNIT_WORDS for word in words.split()}
PLAIN = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
_EPOCH_S, _EPOCH_UNITS_S = (6.3e8, 4.2e9), (1.0, 1e-3, 1e-6, 1e-9)
"""Smallest and largest Unix times of 1990 to 2100, and their units in seconds."""
_SERIAL_DAYS, _SERIAL_ZERO, _SERIAL_STEP = (32_874, 73_050), 25_569, 0.05
"""Days of a spreadsheet from 1990 to 2100, that of 1970, and steps that are shorter than those of other numbers."""


@dataclass(frozen=True)
class TimeColumn:
    """The columns that hold the time, and their form.

    Attributes:
        columns: their numbers: one, two for a date and a time of day, none for a period.
        unit: unit of numbers, from the name or as stated; empty: unknown.
        pattern: form of timestamps; None: numbers.
        is_standard: the name and unit are those of a record of this software.
    """

    columns: tuple[int, ...]
    unit: str = ""
    pattern: Pattern | None = None
    is_standard: bool = False


def choose_time(layout: Layout, stated: FileFormat, taken: Collection[int]) -> TimeColumn:
    """Choose the time column.

    Args:
        layout: the table.
        stated: statements of the user.
        taken: columns of signals.

    Raises:
        InputError: none or several could be it.
    """
    if stated.period is not None:
        return TimeColumn(())
    if stated.time is not None:
        asked = layout.find(stated.time)
        if asked is None:
            rule = f"expected a column {stated.time!r} (--time), got {layout.describe_names(stated.time)}"
            raise InputError(f"{layout.path}, row {layout.header_row or 1}: {rule}")
        return _describe(layout, asked, stated)
    for name, unit in STANDARD.items():
        if name in layout.names and (column := layout.names.index(name)) not in taken:
            item = _describe(layout, column, stated)
            is_stamp = layout.kinds[column] == TIME
            if stated.time_unit is None and stated.time_format is None and not is_stamp:
                return TimeColumn((column,), unit, is_standard=True)
            if not is_stamp or (item.pattern or CLOCK).has_date:  # a time of day may have a date beside it
                return item
    candidates = [_describe(layout, column, stated) for column in range(len(layout.names)) if column not in taken]
    stamps = [item for item in candidates if item.pattern is not None]
    if len(stamps) == 2 and {(item.pattern or CLOCK).has_date for item in stamps} == {True, False}:
        date, clock = sorted(stamps, key=lambda item: not (item.pattern or CLOCK).has_date)
        if not (date.pattern or CLOCK).has_clock:
            columns = (*date.columns, *clock.columns)
            cells = [f"{one} {other}" for one, other in zip(*map(layout.cells, columns), strict=True)]
            return TimeColumn(columns, pattern=guess_pattern(cells))
    stamps = [item for item in stamps if len(set(layout.cells(item.columns[0]))) > 2] or stamps  # not a query's ends
    named = [
        item
        for item in candidates
        if item.pattern is None and layout.kinds[item.columns[0]] == NUMBER and _has_time_name(layout, item)
    ]
    found = [*stamps, *(item for item in named if _increases(layout, item))]
    if not found:
        numbers = [item for item in candidates if _increases(layout, item)]
        found = [item for item in numbers if find_epoch(layout, item, sample_values(layout, item.columns[0]))]
        found = found or [item for item in numbers if counts_rows(layout, item.columns[0])] or named
    if len(found) > 1:
        names = ", ".join(repr(layout.names[item.columns[0]]) for item in found)
        raise InputError(f"{layout.path}: {len(found)} columns could be the time: {names}; state --time NAME")
    if not found:
        _refuse_without_time(layout, taken)
    return found[0]


def _describe(layout: Layout, column: int, stated: FileFormat) -> TimeColumn:
    """Form of a column if it is the time."""
    if stated.time_format is not None:
        pattern = stated_pattern(stated.time_format)
        fits = stated.time is not None or guess_pattern(layout.cells(column), (pattern, *PATTERNS)) is not None
        return TimeColumn((column,), pattern=pattern if fits else None)
    if stated.time_unit not in (None, "iso") and layout.kinds[column] != TIME:
        return TimeColumn((column,), stated.time_unit or "")
    name = layout.names[column]
    words = re.findall(r"[^\W\d_]+", layout.units[column] or "")[:1] or re.findall(r"[^\W\d_]+", name)[-1:]
    return TimeColumn(
        (column,), _UNIT_OF.get(words[0].lower(), "") if words else "", guess_pattern(layout.cells(column))
    )


def may_be_time(layout: Layout, column: int) -> bool:
    """True for a column of timestamps, or of numbers under a name of times."""
    kind = layout.kinds[column]
    return kind == TIME or (kind == NUMBER and _has_time_name(layout, TimeColumn((column,))))


def _has_time_name(layout: Layout, item: TimeColumn) -> bool:
    name = bare_name(layout.names[item.columns[0]])
    words = {word if word == "T" else word.lower() for word in re.findall(r"[^\W_]+", name)}
    return bool(words & _TIME_WORDS or (name.lower() in _TIME_WORDS and name != "T"))


def counts_rows(layout: Layout, column: int) -> bool:
    """True for a first column that counts the rows or their times, under a name that says nothing."""
    name = layout.names[column].lower()
    values = sample_values(layout, column)
    steps = np.diff(values)
    if column != 0 or not steps.size or float(np.ptp(steps)) > 1e-6 * max(abs(values[-1]), steps[0]):
        return False
    return steps[0] > 0 and (layout.header_row is None or name == "1" or name in _INDEX_WORDS)


def sample_values(layout: Layout, column: int) -> NDArray[np.float64]:
    """Numbers in the sample of a column, without cells that are none."""
    cells = [cell.strip().replace(",", ".") for cell in layout.cells(column)]
    return np.array([float(cell) for cell in cells if PLAIN.fullmatch(cell)])


def _increases(layout: Layout, item: TimeColumn) -> bool:
    steps = np.diff(sample_values(layout, item.columns[0]))
    is_ordered = bool(np.count_nonzero(steps <= 0) <= MAX_SHARE_BACK * steps.size)
    return is_ordered and layout.kinds[item.columns[0]] == NUMBER


class Epoch(NamedTuple):
    """Clock time in numbers: the unit, and the number of 1970 in it."""

    name: str
    unit_s: float
    zero: float = 0.0


def find_epoch(layout: Layout, item: TimeColumn, values: NDArray[np.float64]) -> Epoch | None:
    """Clock time that numbers stand for; None: they are no clock time."""
    usable = values[np.isfinite(values)]
    if item.is_standard or not usable.size:
        return None
    low, high = float(usable.min()), float(usable.max())
    for unit_s in _EPOCH_UNITS_S:
        if (
            _EPOCH_S[0] <= low * unit_s
            and high * unit_s <= _EPOCH_S[1]
            and (not item.unit or SECONDS[item.unit] == unit_s)
        ):
            return Epoch("seconds since 1970", unit_s)
    is_dated = "dat" in layout.names[item.columns[0]].lower()
    is_dense = usable.size > 1 and float(np.abs(np.diff(usable)).max()) < _SERIAL_STEP
    if _SERIAL_DAYS[0] <= low and high <= _SERIAL_DAYS[1] and item.unit in ("", "d") and (is_dated or is_dense):
        return Epoch("days of a spreadsheet", SECONDS["d"], _SERIAL_ZERO)
    return None


def _refuse_without_time(layout: Layout, taken: Collection[int]) -> None:
    if len(layout.names) > 1 and layout.header_row is not None and not layout.sample:
        raise InputError(f"{layout.path}: expected rows below the header, got none")
    expected = " or ".join(map(repr, STANDARD))
    found = ", ".join(map(repr, layout.names))
    signals = [layout.names[column] for column in sorted(taken) if _has_time_name(layout, TimeColumn((column,)))]
    if signals:
        found += f", of which {', '.join(map(repr, signals))} is read as a signal"
    if len(layout.names) == 1:
        found += "; the cells must be separated, such as by commas (--separator)"
    raise InputError(
        f"{layout.path}, row {layout.header_row or layout.first_row}: expected a column {expected} in the header, "
        f"or another that looks like a time, got {found}; state --time NAME, or --period"
    )
