"""Read a record from a table of any common form: what is not stated is guessed, and the guesses are noted."""

import shlex
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, hint_at_closest
from reactorwatch.records.cells import EMPTY, NUMBER, TEXT, describe_sentinels
from reactorwatch.records.decode import read_text
from reactorwatch.records.file_format import GUESS, RUN_COLUMN, FileFormat
from reactorwatch.records.historian import (
    LongFormat,
    QualityFilter,
    check_stated,
    find_long_format,
    find_qualities,
    read_tags,
)
from reactorwatch.records.layout import sniff
from reactorwatch.records.record import LARGEST_VALUE, Record, join_repeats
from reactorwatch.records.table import Layout, TextTable, bare_name, unit_of_name
from reactorwatch.records.times import (
    MAX_SHARE_BACK,
    TimeColumn,
    Times,
    check_times,
    choose_time,
    counts_rows,
    find_runs,
    find_written_zero_ns,
    is_newest_first,
    may_be_time,
    numbered_runs,
    read_times,
)
from reactorwatch.units import UnknownUnitError, conversion


class MissingColumnError(InputError):
    """A table has no column, or no rows, of a required signal."""


@dataclass(frozen=True)
class SignalColumn:
    """Signal of a process, and the column that holds it.

    Attributes:
        name: name of the signal.
        unit: unit of the signal; empty: that of the column.
        role: input, output, setpoint, mode or label; texts of a mode or a label are numbered.
        column: header or number (from 1) of the column; None: as `name`.
        required: the file must have it.
    """

    name: str
    unit: str = ""
    role: str = "output"
    column: str | None = None
    required: bool = True


def read_table(path: Path, signals: Sequence[SignalColumn] | None = None, stated: FileFormat = GUESS) -> Record:
    """Read a record.

    Args:
        path: text with any separator, perhaps compressed, a workbook (.xlsx) or a Parquet file.
        signals: the signals to be read; None: each column of numbers, under its name without unit.
        stated: statements about the file that override the guesses.

    Returns:
        The record. Where the file has clock time, its minutes count from the first row. `read_as` has the guesses.

    Raises:
        InputError: the file cannot be read, is malformed or can be read in several ways; one line with file, row (as
            a text editor counts), column, rule, value and cure.
    """
    text, notes = read_text(path, stated.sheet)
    layout = sniff(path, text, stated)
    notes = [*notes, *layout.notes]
    asked = [signal.column or signal.name for signal in signals or ()]
    _check_names(layout, None if signals is None else asked, stated)
    long = find_long_format(layout, stated, asked)
    if long is not None:
        return _read_long(layout, long, signals, stated, notes)
    mapped = _find_columns(layout, signals or ())
    notes += _find_in_other_case(layout, signals or (), mapped, stated)
    time = choose_time(layout, stated, [column for column in mapped.values() if column is not None])
    _check_required(layout, signals or (), mapped)
    taken = {*time.columns, *(column for column in mapped.values() if column is not None)}
    columns = [column for column in range(len(layout.names)) if column not in time.columns]
    of = find_qualities(layout, [column for column in columns if column not in taken], stated, columns)
    check_stated(layout, of, stated)
    of = {column: values for column, values in of.items() if signals is None or taken.intersection(values)}
    sources = _sources(layout, signals, mapped, (*time.columns, *of))
    texts = [column for signal, column in sources if _is_coded(layout, signal, column)]
    run = layout.names.index(RUN_COLUMN) if RUN_COLUMN in layout.names and RUN_COLUMN not in asked else None
    stamps = time.columns if time.pattern is not None else ()
    table = TextTable(
        layout,
        [
            *(time.columns if time.pattern is None else ()),
            *(column for _, column in sources if column not in texts),
        ],
        [*stamps, *texts, *of, *([] if run is None else [run])],
    )
    notes += table.notes
    if is_newest_first(layout, time, stated.dates):
        table, notes = table.select(np.arange(table.rows)[::-1]), [*notes, "newest row first"]
    qualities = QualityFilter(table, of, stated)
    return _make_record(table, time, read_times(table, time, stated), sources, run, notes, qualities)


def _check_names(layout: Layout, asked: Sequence[str] | None, stated: FileFormat) -> None:
    """Check that names of columns that may be read occur once: those asked for, or all columns of numbers."""
    wanted, count = {*(asked or ()), stated.time}, Counter(layout.names)
    for name, kind in zip(layout.names, layout.kinds, strict=True):
        is_read = kind == NUMBER if asked is None else name in wanted
        if is_read and count[name] > 1:
            raise InputError(
                f"{layout.path}, row {layout.header_row}: expected each column name once, got {name!r} more than once"
                "; name it by its number, as in column = 3"
            )


def _find_columns(layout: Layout, signals: Sequence[SignalColumn]) -> dict[str, int | None]:
    """Number of each signal's column; None: there is none."""
    found: dict[str, int | None] = {}
    owners: dict[int | None, str] = {}
    for signal in signals:
        column = layout.find(signal.column or signal.name, by_number=bool(signal.column))
        other = owners.setdefault(column, signal.name)
        if column is not None and other != signal.name:
            raise InputError(
                f"{layout.path}: each signal must have a column of its own, got column {column + 1}, "
                f"{layout.names[column]!r}, for {other} and {signal.name}; leave one out"
            )
        found[signal.name] = column
    return found


def _find_in_other_case(
    layout: Layout, signals: Sequence[SignalColumn], mapped: dict[str, int | None], stated: FileFormat
) -> list[str]:
    """Add the columns of signals under names in another case; a note for each."""
    free = [column for column in range(len(layout.names)) if column not in mapped.values()]
    times = (
        [column for column in free if may_be_time(layout, column)]
        if stated.time is None
        else [layout.find(stated.time)]
    )
    if stated.period is None and len(times) == 1:
        free = [column for column in free if column not in times]
    names = [bare_name(layout.names[column]) for column in free]
    matched = _match_case([item.name for item in signals if not item.column and mapped[item.name] is None], names)
    mapped |= {signal: free[names.index(name)] for signal, name in matched.items()}
    return [f"{signal} from `{name}`" for signal, name in matched.items()]


def _match_case(signals: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Name of each signal in another case, where only one signal and only one name are alike."""
    alike = Counter(map(str.casefold, signals)), Counter(map(str.casefold, names))
    return {
        signal: name
        for signal in signals
        for name in names
        if name.casefold() == (key := signal.casefold()) and alike[0][key] == alike[1][key] == 1
    }


def _check_required(layout: Layout, signals: Sequence[SignalColumn], mapped: dict[str, int | None]) -> None:
    for signal in signals:
        if signal.required and mapped[signal.name] is None:
            asked = signal.column or signal.name
            named = f" (for {signal.name})" if asked != signal.name else ""
            cure = shlex.quote(f"{signal.name}=NAME")
            raise MissingColumnError(
                f"{layout.path}, row {layout.header_row or layout.first_row}: expected a column {asked!r} in the header"
                f"{named}, got {layout.describe_names(asked)}; --column {cure} names another"
            )


def _sources(
    layout: Layout, signals: Sequence[SignalColumn] | None, mapped: dict[str, int | None], others: Sequence[int]
) -> list[tuple[SignalColumn, int]]:
    """Signals to be read, and their columns."""
    if signals is not None:
        pairs = ((signal, mapped[signal.name]) for signal in signals)
        return [(signal, column) for signal, column in pairs if column is not None]
    bare = [bare_name(name) for name in layout.names]
    sources, count = [], Counter(bare)
    for column, name in enumerate(layout.names):
        is_unnamed = layout.header_row is not None and name == str(column + 1)
        is_unnamed = is_unnamed and (layout.kinds[column] == EMPTY or counts_rows(layout, column))
        if column in others or name == RUN_COLUMN or is_unnamed or layout.kinds[column] not in (NUMBER, EMPTY):
            continue
        own = bare[column] if count[bare[column]] == 1 else name
        sources.append((SignalColumn(own), column))
    if not sources:
        raise InputError(
            f"{layout.path}, row {layout.first_row}: expected columns of numbers, got only text in "
            f"{', '.join(map(repr, layout.names))}; state --separator, --decimal or --missing if they are numbers"
        )
    return sources


def _is_coded(layout: Layout, signal: SignalColumn, column: int) -> bool:
    return signal.role in ("mode", "label") and layout.kinds[column] == TEXT


def _make_record(
    table: TextTable,
    time: TimeColumn,
    times: Times,
    sources: Sequence[tuple[SignalColumn, int]],
    run: int | None,
    notes: list[str],
    qualities: QualityFilter,
) -> Record:
    layout = table.layout
    columns, units, measured = {}, {}, dict[str, Array]()
    notes = [*notes, *times.notes]
    for signal, column in sources:
        name = signal.name
        if _is_coded(layout, signal, column):
            cells = table.texts(column).dictionary_encode()
            words = cells.dictionary.to_pylist()
            codes = np.array([np.nan if word.strip() in layout.missing else code for code, word in enumerate(words)])
            columns[name] = codes[np.asarray(cells.indices)]
            known = (f"{word} = {code:g}" for word, code in zip(words, codes, strict=True) if not np.isnan(code))
            notes.append(f"{name}: {', '.join(known)}")
        else:
            columns[name] = qualities.keep_good(column, table.numbers(column))
            check_values(table, column, columns[name])
            if signal.role not in ("mode", "label"):
                measured[name] = columns[name]
        columns[name], units[name] = _convert(layout, signal, column, layout.units[column], columns[name], notes)
    notes += [*describe_sentinels(measured), *qualities.notes]
    minutes, zero_ns = times.since_first()
    zero_ns = zero_ns or find_written_zero_ns(layout, time, [column for _, column in sources])
    runs = numbered_runs(table, run)
    rows = filled_rows(times, columns)
    if rows.size < table.rows:
        minutes, runs = minutes[rows], None if runs is None else runs[rows]
        columns = {name: values[rows] for name, values in columns.items()}
    stay, columns, repeats = join_repeats(minutes, columns, runs, MAX_SHARE_BACK)
    rows, minutes, runs = rows[stay], minutes[stay], None if runs is None else runs[stay]
    check_times(table, time, times, minutes, runs, rows)
    notes += [f"{text}: {count}" for text, count in repeats.items()]
    return Record(
        minutes,
        columns,
        layout.path.name,
        zero_ns,
        first_row=table.first_row if rows.size == table.rows else None,
        runs=find_runs(layout, time, minutes, runs),
        units={name: unit for name, unit in units.items() if unit},
        read_as=", ".join(
            [*notes, *_describe_texts(layout, [*time.columns, *qualities.columns], sources)] if notes else notes
        ),
    )


def _describe_texts(layout: Layout, others: Sequence[int], sources: Sequence[tuple[SignalColumn, int]]) -> list[str]:
    used = {*others, *(column for _, column in sources)}
    unused = [column for column, kind in enumerate(layout.kinds) if kind == TEXT and column not in used]
    return [f"text left out: {', '.join(f'`{layout.names[column]}`' for column in unused)}"] if unused else []


def _convert(
    layout: Layout, signal: SignalColumn, column: int, unit: str, values: NDArray[np.float64], notes: list[str]
) -> tuple[NDArray[np.float64], str]:
    """Values of a column, whose unit is given, in the unit of the signal, and that unit."""
    if not (signal.unit and unit) or signal.unit == unit:
        return values, signal.unit or unit
    name = f"{layout.path}, row {layout.header_row}, column {layout.names[column]!r}"
    try:
        scale, offset = conversion(unit, signal.unit, name)
    except UnknownUnitError:
        notes.append(f"{signal.name} in {signal.unit}, whatever {unit!r} means")
        return values, signal.unit
    except InputError as error:
        raise InputError(f"{error}; correct the header or the unit of signal {signal.name!r}") from error
    if (scale, offset) == (1.0, 0.0):
        return values, signal.unit
    notes.append(f"{signal.name} from {unit} to {signal.unit}")
    return scale * values + offset, signal.unit


def _read_long(
    layout: Layout, long: LongFormat, signals: Sequence[SignalColumn] | None, stated: FileFormat, notes: list[str]
) -> Record:
    """Read a table with a row for each value; the last of several values of a tag at one time counts."""
    wanted = None if signals is None else [signal.column or signal.name for signal in signals]
    series, is_clock, guesses = read_tags(layout, long, stated, wanted)
    by_name = {bare_name(tag): tag for tag in series} | {tag: tag for tag in series}
    missing = [item.name for item in signals or () if not item.column and item.name not in by_name]
    matched = _match_case(missing, [name for name in map(bare_name, series) if name not in (wanted or ())])
    by_name |= {signal: by_name[name] for signal, name in matched.items()}
    notes = [*notes, *(f"{signal} from `{name}`" for signal, name in matched.items())]
    if signals is None:
        signals = [SignalColumn(bare_name(tag)) for tag in series]
    times = np.unique(np.concatenate([item.times for item in series.values()]))
    columns, units, measured, notes, repeats = {}, {}, dict[str, Array](), [*notes, *guesses], Counter[str]()
    for signal in signals:
        tag = by_name.get(signal.column or signal.name)
        if tag is None:
            if signal.required:
                asked = signal.column or signal.name
                found = ", ".join(map(repr, series)) + hint_at_closest(asked, series)
                raise MissingColumnError(f"{layout.path}: expected rows of the tag {asked!r}, got {found}")
            continue
        order = np.argsort(series[tag].times, kind="stable")
        own = series[tag].times[order]
        stay, joined, counts = join_repeats(own, {tag: series[tag].values[order]})
        repeats += counts
        values = np.full(times.size, np.nan)
        values[np.searchsorted(times, own[stay])] = joined[tag]
        measured[signal.name] = values
        columns[signal.name], units[signal.name] = _convert(
            layout, signal, long.value, unit_of_name(tag), values, notes
        )
    notes += describe_sentinels(measured)
    minutes, zero_ns = Times(times, np.full(times.size, fill_value=True), is_clock, []).since_first()
    known = {name: unit for name, unit in units.items() if unit}
    notes += [f"{text}: {count}" for text, count in repeats.items()]
    return Record(minutes, columns, layout.path.name, zero_ns, units=known, read_as=", ".join(notes))


def filled_rows(times: Times, columns: dict[str, NDArray[np.float64]]) -> NDArray[np.intp]:
    """Indices of the rows that have a time, or in which anything was measured."""
    filled = times.valid.copy()
    if not filled.all():
        for values in columns.values():
            filled |= ~np.isnan(values)
    return np.flatnonzero(filled)


def check_values(table: TextTable, column: int, values: NDArray[np.float64]) -> None:
    """Check that the values of a column are possible measurements."""
    if max(np.fmax.reduce(values, initial=0.0), -np.fmin.reduce(values, initial=0.0)) < LARGEST_VALUE:
        return
    row = int(np.flatnonzero(np.abs(values) >= LARGEST_VALUE)[0])
    if np.isinf(values[row]):
        table.refuse(row, column, "expected a finite number or nothing")
    rule = f"expected a number below {LARGEST_VALUE:g}, or nothing where nothing was measured"
    table.refuse(row, column, rule)
