"""The time column of a table: chosen by name and content, and converted to minutes and a zero."""

import re
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.cells import NUMBER
from reactorwatch.records.file_format import SECONDS, FileFormat
from reactorwatch.records.layout import Layout, bare_name
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.records.text_table import TextTable
from reactorwatch.records.timestamps import CLOCK, DAY_NS, PATTERNS, Pattern, guess_pattern, parse, stated_pattern
from reactorwatch.records.zones import HOUR_NS, to_utc

STANDARD = {"time_min": "min", "time_s": "s"}
"""Names of time columns that need no guess, and their units."""

MAX_SHARE_BACK = 1 / 3
"""Largest share of rows with a step back in time; a file with more is not in time order."""

_TIME_NAMES = """
time zeit t ts tstamp timestamp datetime date datum uhrzeit zeitstempel zeitpunkt elapsed epoch unix clock temps heure
horodatage fecha hora tiempo tempo seconds minutes hours sekunden minuten stunden x_value"""
_INDEX_NAMES = "index idx sample samples row rows nr no n i k step steps id # zeile schritt"
_TIME_WORDS, _INDEX_WORDS = frozenset(_TIME_NAMES.split()), frozenset(_INDEX_NAMES.split())
_UNIT_WORDS = {
    "ns": ("ns",),
    "us": ("us", "µs"),
    "ms": ("ms", "msec", "millis", "milliseconds"),
    "s": ("s", "sec", "secs", "second", "seconds", "sek", "sekunden"),
    "min": ("min", "mins", "minute", "minutes", "minuten"),
    "h": ("h", "hr", "hrs", "hour", "hours", "std", "stunden"),
    "d": ("d", "day", "days", "tage"),
}
_UNIT_OF = {word: unit for unit, words in _UNIT_WORDS.items() for word in words}
_EPOCHS_S = ((6.3e8, 4.2e9, 1.0), (6.3e11, 4.2e12, 1e-3), (6.3e14, 4.2e15, 1e-6), (6.3e17, 4.2e18, 1e-9))
"""Smallest and largest Unix times of 1990 to 2100, and their unit."""


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


@dataclass(frozen=True)
class Times:
    """Times of the rows.

    Attributes:
        values: minutes, or nanoseconds since 1970-01-01 UTC; shape (rows,).
        valid: False where a row has no time, shape (rows,).
        is_clock: the times are clock times, in nanoseconds.
        notes: guesses, for people.
    """

    values: NDArray[np.float64] | NDArray[np.int64]
    valid: NDArray[np.bool_]
    is_clock: bool
    notes: list[str]

    def since_first(self) -> tuple[NDArray[np.float64], int]:
        """Minutes, NaN without a time, and their zero in nanoseconds since 1970; 0: unknown."""
        if not self.is_clock or not self.valid.any():
            return np.asarray(self.values, dtype=np.float64), 0
        zero_ns = int(self.values[self.valid][0])
        return np.where(self.valid, (self.values - zero_ns) / MINUTE_NS, np.nan), zero_ns


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
        return _describe(layout, find_column(layout, stated.time, "--time"), stated)
    for name, unit in STANDARD.items():
        if name in layout.names and layout.names.index(name) not in taken:
            return TimeColumn((layout.names.index(name),), unit, is_standard=True)
    candidates = [_describe(layout, column, stated) for column in range(len(layout.names)) if column not in taken]
    stamps = [item for item in candidates if item.pattern is not None]
    if len(stamps) == 2 and {(item.pattern or CLOCK).has_date for item in stamps} == {True, False}:
        date, clock = sorted(stamps, key=lambda item: not (item.pattern or CLOCK).has_date)
        if not (date.pattern or CLOCK).has_clock:
            columns = (*date.columns, *clock.columns)
            cells = [f"{one} {other}" for one, other in zip(*map(layout.cells, columns), strict=True)]
            return TimeColumn(columns, pattern=guess_pattern(cells))
    named = [
        item
        for item in candidates
        if item.pattern is None and _has_time_name(layout, item) and _increases(layout, item)
    ]
    found = [*stamps, *named]
    if not found:
        numbers = [item for item in candidates if layout.kind(item.columns[0]) == NUMBER and _increases(layout, item)]
        found = [item for item in numbers if _epoch(_values(layout, item))]
        found = found or [item for item in numbers if _is_index(layout, item)]
    if len(found) > 1:
        names = ", ".join(repr(layout.names[item.columns[0]]) for item in found)
        raise InputError(f"{layout.path}: {len(found)} columns could be the time: {names}; state --time NAME")
    if not found:
        _refuse_without_time(layout)
    return found[0]


def find_column(layout: Layout, name: str, option: str) -> int:
    """Number of a column by its header, its name without unit, or its number from 1.

    Raises:
        InputError: there is none, or several.
    """
    for names in (layout.names, [bare_name(each) for each in layout.names]):
        if names.count(name) == 1:
            return names.index(name)
    if name.isdigit() and 1 <= int(name) <= len(layout.names):
        return int(name) - 1
    found = ", ".join(map(repr, layout.names))
    raise InputError(f"{layout.path}, row {layout.header_row or 1}: expected a column {name!r} ({option}), got {found}")


def read_times(table: TextTable, column: TimeColumn, stated: FileFormat) -> Times:
    """Read the times of the rows.

    Raises:
        InputError: a cell is no time, or local times are ambiguous.
    """
    if stated.period is not None:
        minutes = np.arange(table.rows, dtype=np.float64) * ((stated.period_s or 0.0) / 60.0)
        return Times(minutes, np.isfinite(minutes), is_clock=False, notes=[f"a row each {stated.period}"])
    name = " ".join(f"`{table.layout.names[number]}`" for number in column.columns)
    if column.pattern is not None:
        return _read_stamps(table, column, column.pattern, stated, name)
    values = table.numbers(column.columns[0], "expected a finite number")
    valid = np.isfinite(values)
    epoch_s = None if column.is_standard else _epoch(values)
    if epoch_s is not None and (not column.unit or SECONDS[column.unit] == epoch_s):
        whole = np.round(np.nan_to_num(values) * epoch_s * 1e6).astype(np.int64) * 1000
        return Times(whole, valid, is_clock=True, notes=[f"time {name} seconds since 1970"])
    unit = column.unit or "s"
    notes = [] if column.is_standard else [f"time {name} in {unit}"]
    return Times(values / units_per_minute(unit), valid, is_clock=False, notes=notes)


def units_per_minute(unit: str) -> float:
    """Units of time in a minute."""
    return 60.0 / SECONDS[unit]


def _describe(layout: Layout, column: int, stated: FileFormat) -> TimeColumn:
    """Form of a column if it is the time."""
    if stated.time_format is not None:
        pattern = stated_pattern(stated.time_format)
        fits = stated.time is not None or guess_pattern(layout.cells(column), (pattern, *PATTERNS)) is not None
        return TimeColumn((column,), pattern=pattern if fits else None)
    if stated.time_unit is not None and stated.time_unit != "iso":
        return TimeColumn((column,), stated.time_unit)
    name = layout.names[column]
    words = re.findall(r"[^\W\d_]+", layout.units[column] or "")[:1] or re.findall(r"[^\W\d_]+", name)[-1:]
    return TimeColumn(
        (column,), _UNIT_OF.get(words[0].lower(), "") if words else "", guess_pattern(layout.cells(column))
    )


def _has_time_name(layout: Layout, item: TimeColumn) -> bool:
    name = bare_name(layout.names[item.columns[0]])
    words = {word if word == "T" else word.lower() for word in re.findall(r"[^\W_]+", name)}
    return bool(words & _TIME_WORDS or (name.lower() in _TIME_WORDS and name != "T"))


def _is_index(layout: Layout, item: TimeColumn) -> bool:
    """True for a first column that counts the rows or their times, under a name that says nothing."""
    name = layout.names[item.columns[0]].lower()
    values = _values(layout, item)
    steps = np.diff(values)
    if item.columns[0] != 0 or not steps.size or float(np.ptp(steps)) > 1e-6 * max(abs(values[-1]), steps[0]):
        return False
    return layout.header_row is None or name == "1" or name in _INDEX_WORDS


def _values(layout: Layout, item: TimeColumn) -> NDArray[np.float64]:
    """Numbers in the sample of a column, without those that are none."""
    cells = [cell.strip().replace(",", ".") for cell in layout.cells(item.columns[0])]
    return np.array(
        [float(cell) for cell in cells if re.fullmatch(r"[+-]?[\d.]+(?:[eE][+-]?\d+)?", cell) and cell.count(".") < 2]
    )


def _increases(layout: Layout, item: TimeColumn) -> bool:
    steps = np.diff(_values(layout, item))
    is_ordered = bool(np.count_nonzero(steps <= 0) <= MAX_SHARE_BACK * steps.size)
    return is_ordered and layout.kind(item.columns[0]) == NUMBER


def _epoch(values: NDArray[np.float64]) -> float | None:
    """Unit in seconds of Unix times; None if the numbers are no Unix times."""
    if not values.size:
        return None
    low, high = np.nanmin(values), np.nanmax(values)
    return next((unit for least, most, unit in _EPOCHS_S if least <= low and high <= most), None)


def _read_stamps(table: TextTable, column: TimeColumn, pattern: Pattern, stated: FileFormat, name: str) -> Times:
    import pyarrow.compute as pc

    cells = pc.binary_join_element_wise(*(pc.fill_null(table.texts(number), "") for number in column.columns), " ")
    try:
        instants, form = parse(cells, pattern)
    except ValueError as error:
        cure = "state --time-format %d/%m/%Y or %m/%d/%Y, with the time of day"
        raise InputError(f"{table.layout.path}, column {name}: day and month are ambiguous; {cure}") from error
    at = column.columns[0]
    wrong = np.flatnonzero(~instants.valid & ~np.asarray(pc.equal(pc.utf8_trim_whitespace(cells), "")))
    if wrong.size:
        table.refuse(int(wrong[0]), at, f"expected a time of the form {form}", "state --time-format if it is another")
    notes, local_ns = [f"time {name} {form}"], instants.local_ns
    if not pattern.has_date:
        local_ns = local_ns + DAY_NS * np.cumsum(np.diff(local_ns, prepend=local_ns[:1]) < -12 * HOUR_NS)
        return Times(
            np.where(instants.valid, local_ns / MINUTE_NS, np.nan), instants.valid, is_clock=False, notes=notes
        )
    offset = np.isfinite(instants.offset_s)
    if offset.any():
        if not offset[instants.valid].all():
            row = int(np.flatnonzero(instants.valid & ~offset)[0])
            table.refuse(
                row, at, "expected a time with a known offset from UTC, as in other rows", "write it as +01:00"
            )
        return Times(
            local_ns - (np.nan_to_num(instants.offset_s) * 1e9).astype(np.int64),
            instants.valid,
            is_clock=True,
            notes=notes,
        )
    zone = stated.zone or _zone_in_name(table.layout, column)
    if zone is not None:
        rows = np.flatnonzero(instants.valid)
        utc_ns = local_ns.copy()
        utc_ns[rows] = to_utc(
            local_ns[rows], zone, lambda row, rule: table.refuse(int(rows[row]), at, rule, "state --zone")
        )
        return Times(utc_ns, instants.valid, is_clock=True, notes=[f"{notes[0]} in {zone}"])
    steps = np.diff(local_ns)
    usual = float(np.median(steps)) if (steps <= 0).any() else 0.0
    back = (
        np.flatnonzero(np.abs(steps + HOUR_NS - usual) < max(usual / 2, 1e9))
        if usual < HOUR_NS
        else np.flatnonzero(steps == 0)
    )
    back = back[steps[back] <= 0]
    if back.size:
        rule = "expected increasing times; the clock steps back by an hour, as at the end of summer time"
        table.refuse(int(back[0]) + 1, at, rule, "state the zone, such as --zone Europe/Berlin (--zone UTC: none)")
    return Times(local_ns, instants.valid, is_clock=True, notes=[*notes, "time zone unknown, taken as UTC"])


def _zone_in_name(layout: Layout, column: TimeColumn) -> str | None:
    """Zone that the header names; only UTC is certain."""
    texts = [layout.names[number] + " " + layout.units[number] for number in column.columns]
    return "UTC" if any(re.search(r"\b(?:UTC|GMT|utc)\b", text) for text in texts) else None


def _refuse_without_time(layout: Layout) -> None:
    expected = " or ".join(map(repr, STANDARD))
    found = ", ".join(map(repr, layout.names))
    if len(layout.names) == 1:
        found += "; the cells must be separated, such as by commas (--separator)"
    raise InputError(
        f"{layout.path}, row {layout.header_row or layout.first_row}: expected a column {expected} in the header, "
        f"or another that looks like a time, got {found}; state --time NAME, or --period"
    )
