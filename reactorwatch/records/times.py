"""Times of the rows of a table: from timestamps, numbers or a period, to minutes and a zero."""

import re
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.file_format import SECONDS, FileFormat
from reactorwatch.records.layout import Layout
from reactorwatch.records.record import MINUTE_NS, to_time_ns
from reactorwatch.records.text_table import TextTable
from reactorwatch.records.time_column import MAX_SHARE_BACK, PLAIN, TimeColumn, find_epoch, sample_values
from reactorwatch.records.timestamps import DAY_NS, Pattern, guess_pattern, parse
from reactorwatch.records.write_table import CLOCK
from reactorwatch.records.zones import HOUR_NS, to_utc

MIN_REVERSED = 3
"""Fewest rows of a file that may have its newest row first."""


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
    if not column.columns or len(layout.sample) < MIN_REVERSED:
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
    if not column.is_standard or column.unit != "min" or CLOCK not in layout.names or not layout.sample:
        return 0
    at = layout.names.index(CLOCK)
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
