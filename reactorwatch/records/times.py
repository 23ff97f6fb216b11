"""Times of the rows of a table: the time column, chosen by name and content, and its values in minutes."""

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.cells import NUMBER, TIME
from reactorwatch.records.file_format import CLOCK_COLUMN, SECONDS, FileFormat
from reactorwatch.records.record import LONGEST_MIN, MINUTE_NS, to_time_ns
from reactorwatch.records.table import Layout, TextTable, bare_name
from reactorwatch.records.timestamps import (
    CLOCK,
    DAY_NS,
    HOUR_NS,
    PATTERNS,
    Pattern,
    guess_pattern,
    parse,
    stated_pattern,
    to_utc,
)

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
    for unit_s in (1.0, 1e-3, 1e-6, 1e-9):
        is_in_range = low * unit_s >= 6.3e8 and high * unit_s <= 4.2e9  # 1990 to 2100
        if is_in_range and (not item.unit or SECONDS[item.unit] == unit_s):
            return Epoch("seconds since 1970", unit_s)
    is_dated = "dat" in layout.names[item.columns[0]].lower()
    is_dense = usable.size > 1 and float(np.abs(np.diff(usable)).max()) < 0.05  # other numbers have longer steps
    is_in_range = low >= 32_874 and high <= 73_050  # 1990 to 2100
    if is_in_range and item.unit in ("", "d") and (is_dated or is_dense):
        return Epoch("days of a spreadsheet", SECONDS["d"], 25_569)
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


def read_times(table: TextTable, column: TimeColumn, stated: FileFormat) -> Times:
    """Read the times of the rows.

    Raises:
        InputError: a cell is no time, or local times are ambiguous.
    """
    if stated.period is not None:
        minutes = np.arange(table.rows, dtype=np.float64) * (stated.period_s or 0.0) / 60.0
        return Times(minutes, np.isfinite(minutes), is_clock=False, notes=[f"a row each {stated.period}"])
    name = " ".join(f"`{table.layout.names[number]}`" for number in column.columns)
    if column.pattern is not None:
        return _read_stamps(table, column, column.pattern, stated, name)
    values = table.numbers(column.columns[0], "expected a finite number")
    valid = np.isfinite(values)
    epoch = find_epoch(table.layout, column, values)
    if epoch is not None:
        digits_ns = 1_000_000 if epoch.zero else 1000  # a double holds more
        since = np.where(valid, values - epoch.zero, 0.0)
        time_ns = np.round(since * (epoch.unit_s * 1e9 / digits_ns)).astype(np.int64)
        note = f"time {name} {epoch.name}"
        if not epoch.zero:
            return Times(time_ns * digits_ns, valid, is_clock=True, notes=[note])
        return _to_clock(table, column, time_ns * digits_ns, valid, stated, note)
    unit = column.unit or "s"
    notes = [] if column.is_standard else [f"time {name} in {unit}"]
    seconds = SECONDS[unit]  # whole factors, so that decimal times stay exact
    minutes = values * (seconds / 60.0) if seconds > 60.0 else values / units_per_minute(unit)
    return Times(minutes, valid, is_clock=False, notes=notes)


def is_newest_first(layout: Layout, column: TimeColumn, dates: str | None) -> bool:
    """True if the first rows are before the rows above them, but for blocks that were written again."""
    if not column.columns or len(layout.sample) < 3:  # fewer rows have no order
        return False
    if column.pattern is None:
        steps = np.diff(sample_values(layout, column.columns[0]))
    else:
        import pyarrow as pa

        cells = [" ".join(row[number] for number in column.columns) for row in layout.sample]
        instants, _ = parse(pa.array(cells), column.pattern, dates)
        steps = np.diff(instants.local_ns[instants.valid])
    steps = steps[steps != 0]
    return bool(steps.size and np.count_nonzero(steps > 0) < MAX_SHARE_BACK * steps.size)


def find_written_zero_ns(layout: Layout, column: TimeColumn, taken: Collection[int]) -> int:
    """Zero of the minutes in a table that `write_table` wrote with clock times; 0: it has none."""
    if not column.is_standard or column.unit != "min" or CLOCK_COLUMN not in layout.names or not layout.sample:
        return 0
    at = layout.names.index(CLOCK_COLUMN)
    cell, minutes = layout.sample[0][at], layout.sample[0][column.columns[0]].strip()
    pattern = guess_pattern([cell])
    if at in taken or pattern is None or not pattern.has_date or not PLAIN.fullmatch(minutes):
        return 0
    import pyarrow as pa

    instants, form = parse(pa.array([cell]), pattern)
    if form is None or not instants.valid[0] or not np.isfinite(instants.offset_s[0]):
        return 0
    return int(instants.local_ns[0]) - int(instants.offset_s[0]) * 1_000_000_000 - to_time_ns(float(minutes))


def units_per_minute(unit: str) -> float:
    """Units of time in a minute."""
    return 60.0 / SECONDS[unit]


def _read_stamps(table: TextTable, column: TimeColumn, pattern: Pattern, stated: FileFormat, name: str) -> Times:
    import pyarrow.compute as pc

    cells = pc.binary_join_element_wise(*(pc.fill_null(table.texts(number), "") for number in column.columns), " ")
    instants, form = parse(cells, pattern, stated.dates)
    if form is None:
        rule = f"day and month are ambiguous in all rows, such as {str(cells[0])!r}"
        raise InputError(f"{table.layout.path}, column {name}: {rule}; state --dates month-first or --dates day-first")
    at = column.columns[0]
    wrong = np.flatnonzero(~instants.valid & ~np.asarray(pc.equal(pc.utf8_trim_whitespace(cells), "")))
    if wrong.size:
        table.refuse(
            int(wrong[0]), at, f"expected a time of the form {form}", "state --time-format or --dates if it is another"
        )
    notes, local_ns = [f"time {name} {form}"], instants.local_ns
    if not pattern.has_date:
        local_ns = local_ns + DAY_NS * np.cumsum(np.diff(local_ns, prepend=local_ns[:1]) < -12 * HOUR_NS)
        minutes = np.where(instants.valid, local_ns / MINUTE_NS, np.nan)
        return Times(minutes, instants.valid, is_clock=False, notes=notes)
    offset = np.isfinite(instants.offset_s)
    if offset.any():
        if not offset[instants.valid].all():
            row = int(np.flatnonzero(instants.valid & ~offset)[0])
            rule = "expected a time with a known offset from UTC, as in other rows"
            table.refuse(row, at, rule, "write it as +01:00")
        utc_ns = local_ns - (np.nan_to_num(instants.offset_s) * 1e9).astype(np.int64)
        return Times(utc_ns, instants.valid, is_clock=True, notes=notes)
    return _to_clock(table, column, local_ns, instants.valid, stated, notes[0])


def _to_clock(
    table: TextTable,
    column: TimeColumn,
    local_ns: NDArray[np.int64],
    valid: NDArray[np.bool_],
    stated: FileFormat,
    note: str,
) -> Times:
    """Clock time of local times: in the zone that is stated or named in the header, else in UTC."""
    at = column.columns[0]
    zone = stated.zone or _zone_in_name(table.layout, column)
    if zone is not None:
        rows = np.flatnonzero(valid)
        utc_ns = local_ns.copy()
        utc_ns[rows] = to_utc(
            local_ns[rows], zone, lambda row, rule: table.refuse(int(rows[row]), at, rule, "state --zone")
        )
        return Times(utc_ns, valid, is_clock=True, notes=[f"{note} in {zone}"])
    steps = np.diff(local_ns)
    usual = float(np.median(steps)) if (steps <= 0).any() else 0.0
    is_hour_back = np.abs(steps + HOUR_NS - usual) < max(usual / 2, 1e9) if usual < HOUR_NS else steps == 0
    is_sunday_night = ((local_ns[1:] // DAY_NS + 4) % 7 == 0) & (local_ns[1:] % DAY_NS < 4 * HOUR_NS)
    back = np.flatnonzero(is_hour_back & ((steps < 0) | (steps == 0) & is_sunday_night))  # others are of one time
    if back.size:
        rule = "expected increasing times; the clock steps back by an hour, as at the end of summer time"
        table.refuse(int(back[0]) + 1, at, rule, "state the zone, such as --zone Europe/Berlin (--zone UTC: none)")
    return Times(local_ns, valid, is_clock=True, notes=[note, "time zone unknown, taken as UTC"])


def _zone_in_name(layout: Layout, column: TimeColumn) -> str | None:
    """Zone that the header names; only UTC is certain."""
    texts = [layout.names[number] + " " + layout.units[number] for number in column.columns]
    return "UTC" if any(re.search(r"\b(?:UTC|GMT|utc)\b", text) for text in texts) else None


def numbered_runs(table: TextTable, column: int | None) -> NDArray[np.intp] | None:
    """Number of each row's run; None if the column does not count up from 1."""
    if column is None:
        return None
    cells = [cell.strip() for cell in table.texts(column).to_pylist()]
    if not all(cell.isdecimal() and len(cell) < 18 for cell in cells):  # 64 bits hold them
        return None
    runs = np.array([int(cell) for cell in cells], dtype=np.intp)
    steps = np.diff(runs, prepend=0)
    return runs if runs.size and runs[0] == 1 and np.all((steps == 0) | (steps == 1)) else None


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
