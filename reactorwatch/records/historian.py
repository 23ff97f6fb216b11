"""The long format of historians: a row for each value, with its time and its tag."""

import re
from collections.abc import Collection, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError, hint_at_closest
from reactorwatch.records.cells import NUMBER, TEXT, to_numbers
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.layout import Layout, bare_name
from reactorwatch.records.quality import QualityFilter, check_stated, find_qualities
from reactorwatch.records.text_table import TextTable
from reactorwatch.records.time_column import TimeColumn, choose_time, counts_rows
from reactorwatch.records.times import read_times

_TAG = re.compile(r"tag|point|signal|variable|sensor|channel|mess(?:stelle|punkt)|kanal|name", re.IGNORECASE)
_VALUE = re.compile(r"val|wert|reading|mess(?!.*zeit)", re.IGNORECASE)
_ID = re.compile(rf"{_TAG.pattern}|(?:\b|_)id$|[a-z]I[Dd]$|device", re.IGNORECASE)
"""Headers of tags, and of those that are numbers."""
_UNIT = re.compile(r"unit|uom|einheit", re.IGNORECASE)

SHARED, SORTED, RESTARTING, ALTERNATING, REGULAR = "shared", "sorted", "restarting", "alternating", "regular"
"""Arrangements of rows: several have one time; they are sorted by tag, on a clock, or with minutes that start again as
those of batches do; tags alternate, or so do the labels of rows at regular times."""

MAX_TAGS = 0.5
"""Largest share of different tags among the rows."""
MIN_DISTINCT = 0.9
"""Smallest share of steps from a value of a tag to its next at which the time goes on."""
MIN_SHARED = 1 / 6
"""Smallest share of rows with the time of the row before; it is 1/2 for two tags that are sampled together."""
MIN_CHANGES = 0.1
"""Smallest share of rows with another tag than the row before, if each tag has times of its own."""
MIN_EXPLAINED = 0.9
"""Smallest share of the variance that tags of different quantities explain."""


class LongFormat(NamedTuple):
    """Columns of a long table, by number: the time, the parts of the tag, the value and its qualities."""

    time: TimeColumn
    tags: tuple[int, ...]
    value: int
    qualities: dict[int, list[int]]


def find_long_format(layout: Layout, stated: FileFormat, names: Collection[str]) -> LongFormat | None:
    """Find the columns of a long table, as stated or by its rows; None if it is wide.

    A table with columns that are asked for by their `names`, beside that of values, is wide.

    Raises:
        InputError: a stated column is not there, or it is not known which column holds the values.
    """
    headers, kinds, columns = layout.names, layout.kinds, range(len(layout.names))
    is_stated = stated.tag is not None or stated.value is not None
    if stated.tag == "none" or (not is_stated and (len(headers) < 3 or not layout.sample)):
        return None
    words = {name for name in names if not name.isdigit()}
    asked = {column for column in columns if {headers[column], bare_name(headers[column])} & words}
    tags, values = (_option_columns(layout, f"--{name}", getattr(stated, name)) for name in ("tag", "value"))
    if set(tags) & set(values):
        raise InputError(f"--tag and --value must name different columns, got {stated.tag!r} and {stated.value!r}")
    if not (is_stated or TEXT in kinds or any(map(_ID.search, headers))):
        return None
    numbered = {int(name) - 1 for name in names if name.isdigit() and layout.header_row is None}
    time = choose_time(layout, stated, {*tags, *values, *asked, *numbered})
    free = [column for column in columns if column not in (*tags, *values, *time.columns)]
    qualities = find_qualities(layout, [column for column in free if column not in asked], stated)
    free = [column for column in free if column not in qualities]
    numbers = [item for item in free if kinds[item] == NUMBER]
    likely = [item for item in numbers if _VALUE.search(headers[item])]
    texts = [item for item in free if kinds[item] == TEXT and item not in asked and not _UNIT.search(headers[item])]
    named = [item for item in texts if _TAG.search(headers[item])] or (texts[:1] if layout.header_row is None else [])
    ids = [item for item in numbers if item not in asked and _ID.search(headers[item])]
    parts = list(dict.fromkeys((*named, *texts, *ids)))
    choices = [tags] if tags else [choice for size in (1, 2) for choice in combinations(parts, size)]
    if not choices or not time.columns:
        if values:
            raise InputError(f"{layout.path}: expected a column of tags, got none beside --value; state --tag NAME")
        return None
    stamps, minutes = _split_time(time)
    table = TextTable(layout, minutes, list(dict.fromkeys((*parts, *tags, *stamps))))
    times = read_times(table, time, stated).values
    found = []
    for choice in choices:
        labels = _tag_cells(table, choice).dictionary_encode()
        index = np.asarray(labels.indices, dtype=np.intp)
        known = {*labels.dictionary.to_pylist(), *map(bare_name, labels.dictionary.to_pylist())}
        shape = "" if "" in known else _arrange(times, index)
        is_given = bool(tags or (values and len(labels.dictionary) > 1) or (words & known and not asked))
        is_named = not asked and choice[0] in named and len(choice) == 1
        if not (shape or is_given or is_named):
            continue
        rest = [item for item in numbers if item not in choice]
        for test in (_has_fractions, _varies):
            rest = [item for item in rest if test(layout, item, choice)] or rest
        value = next((item for item in (*values, *likely) if item not in choice), rest[0] if len(rest) == 1 else None)
        is_apart = value is None or bool(asked - {value, *choice})  # a label of the rows of a wide table
        if is_apart and not is_stated and shape != SHARED:
            continue
        signs = (
            value is not None and _VALUE.search(headers[value]) is not None,
            value is not None and _variance_share(TextTable(layout, minutes, [value]), value, index) >= MIN_EXPLAINED,
            all(re.search(r"\d", label) for label in known),
        )
        is_shown = shape in (SHARED, SORTED) or (shape == RESTARTING and any(signs[:2]))
        is_shown |= shape in (ALTERNATING, REGULAR) and any(signs[1:]) and sum(signs) > (shape == REGULAR)
        if is_shown or is_given or is_named:
            found.append(((not is_shown, not is_given, not signs[1]), choice, None if is_apart else value))
    if not found:
        return None
    _, choice, value = min(found, key=lambda item: item[0])
    if value is None:
        several = ", ".join(repr(headers[item]) for item in numbers if item not in choice)
        expected = f"expected one column of values for the tags of {headers[choice[0]]!r}"
        raise InputError(f"{layout.path}: {expected}, got {several}; state --value NAME, or --tag none")
    check_stated(layout, qualities, stated)
    return LongFormat(time, choice, value, qualities)


def _option_columns(layout: Layout, option: str, name: str | None) -> tuple[int, ...]:
    """Columns that an option names."""
    if name is None:
        return ()
    parts = [name] if layout.find(name) is not None else [part.strip() for part in name.split(",")]
    found = [layout.find(part) for part in parts]
    for part, column in zip(parts, found, strict=True):
        if column is None:
            rule = f"expected a column {part!r} ({option}), got {layout.describe_names(part)}"
            raise InputError(f"{layout.path}, row {layout.header_row or 1}: {rule}")
    return tuple(column for column in found if column is not None)


def _split_time(time: TimeColumn) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Columns of timestamps, and of times in numbers."""
    return ((), time.columns) if time.pattern is None else (time.columns, ())


def _tag_cells(table: TextTable, columns: Sequence[int]) -> Any:
    """Tag of each row, without blanks around it; parts are joined by points."""
    import pyarrow.compute as pc

    return pc.binary_join_element_wise(*(pc.utf8_trim_whitespace(table.texts(column)) for column in columns), ".")


def _has_fractions(layout: Layout, column: int, _: Sequence[int]) -> bool:
    """True for a column of numbers that are not all whole, as codes and counts are."""
    return any("." in cell or "," in cell for cell in layout.cells(column))


def _varies(layout: Layout, column: int, tags: Sequence[int]) -> bool:
    """True for a column of numbers that do not count the rows and differ between rows of one tag."""
    known = [tuple(row[part] for part in tags) for row in layout.sample]
    pairs = set(zip(known, layout.cells(column), strict=True))
    return len(pairs) > len(set(known)) and not counts_rows(layout, column)


def _variance_share(table: TextTable, column: int, tags: NDArray[np.intp]) -> float:
    """Share of the variance of the numbers in a column that tags explain; 1 if no tag has two different numbers."""
    values, _ = to_numbers(table.texts(column), table.layout.decimal, table.layout.missing)
    known = np.isfinite(values)
    values, tags = values[known], tags[known]
    if not values.size:
        return 1.0
    means = np.bincount(tags, values) / np.maximum(np.bincount(tags), 1)
    within, total = float(np.mean((values - means[tags]) ** 2)), float(np.var(values))
    return 1.0 - within / total if within > 1e-12 * total else 1.0


def _arrange(times: NDArray[Any], tags: NDArray[np.intp]) -> str:
    """Arrangement of rows that may be of several tags; empty: they are rows of a wide table."""
    changed, steps = np.diff(tags) != 0, np.diff(times)
    changes = float(np.mean(changed)) if changed.size else 0.0
    if not 1 <= tags.max(initial=0) < MAX_TAGS * tags.size or (changes < MIN_CHANGES and (steps > 0).all()):
        return ""  # most wide tables, without sorting
    order = np.argsort(tags, kind="stable")
    inner = np.diff(times[order])[np.diff(tags[order]) == 0]
    if max(np.mean(inner > 0), np.mean(inner < 0)) < MIN_DISTINCT:
        return ""
    steps = steps if np.median(inner) > 0 else -steps  # the newest may be first
    if np.mean(steps == 0) >= MIN_SHARED:
        return SHARED
    if (steps < 0).any() and changed[steps < 0].all():
        return SORTED if times.dtype.kind == "i" else RESTARTING
    is_regular = np.mean(np.isclose(steps, np.median(steps), rtol=0.1)) > MIN_DISTINCT and changes < MIN_DISTINCT
    return "" if changes < MIN_CHANGES else REGULAR if is_regular else ALTERNATING


class TagSeries(NamedTuple):
    """Times and values of a tag, each of shape (rows of the tag,)."""

    times: NDArray[np.float64] | NDArray[np.int64]
    values: NDArray[np.float64]


def read_tags(
    layout: Layout, long: LongFormat, stated: FileFormat, wanted: Collection[str] | None
) -> tuple[dict[str, TagSeries], bool, list[str]]:
    """Series by tag, all or those wanted; True if their times are nanoseconds since 1970; and guesses, for people.

    Raises:
        InputError: a cell of a tag that is read is no time or no number, or its quality is unknown.
    """
    stamps, minutes = _split_time(long.time)
    table = TextTable(layout, minutes, [*long.tags, long.value, *long.qualities, *stamps])
    tags = _tag_cells(table, long.tags).dictionary_encode()
    qualities = QualityFilter(table, long.qualities, stated)
    index = np.asarray(tags.indices)
    series: dict[str, TagSeries] = {}
    is_clock, notes = False, [""]
    for number, tag in enumerate(tags.dictionary.to_pylist()):
        alike = {tag.casefold(), bare_name(tag).casefold()}
        if not tag or (wanted is not None and alike.isdisjoint(name.casefold() for name in wanted)):
            continue
        rows = np.flatnonzero(index == number)
        part = table.select(rows)
        found = read_times(part, long.time, stated)
        values, is_clock, notes = part.numbers(long.value), found.is_clock, found.notes
        if not found.valid.all():
            part.refuse(int(np.flatnonzero(~found.valid)[0]), long.time.columns[0], "expected a time")
        series[tag] = TagSeries(found.values, qualities.keep_good(long.value, values, rows))
    if not series:
        known = tags.dictionary.to_pylist()
        hints = [*dict.fromkeys(hint_at_closest(name, known) for name in wanted or ())]
        hints += [] if stated.tag else ["; state --tag NAME, or --tag none if each column is a signal"]
        raise InputError(
            f"{layout.path}: expected rows of the tags {', '.join(map(repr, wanted or ()))}, "
            f"got {', '.join(map(repr, known[:20]))}{''.join(hints)}"
        )
    by = " and ".join(f"`{layout.names[column]}`" for column in long.tags)
    return series, is_clock, [*notes, f"a row for each value of `{layout.names[long.value]}` by {by}", *qualities.notes]
