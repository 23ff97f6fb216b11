"""The long format of historians: a row for each value, with its time and its tag."""

import re
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError, hint_at_closest
from reactorwatch.records.cells import NUMBER, TEXT
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.layout import Layout, bare_name
from reactorwatch.records.text_table import TextTable
from reactorwatch.records.time_column import TimeColumn, choose_time
from reactorwatch.records.times import read_times

_TAG = re.compile(r"tag|point|signal|variable|sensor|channel|mess(?:stelle|punkt)|kanal|name", re.IGNORECASE)
_VALUE = re.compile(r"val|wert|reading|mess", re.IGNORECASE)
_QUALITY = re.compile(r"qual|status|confid", re.IGNORECASE)
_GOOD = re.compile(r"\s*(?:good|ok|gut|valid|1|100|19[2-9]|2[0-4]\d|25[0-5])?\b", re.IGNORECASE)
"""Qualities of usable values; OPC's good ones are 192 to 255."""

MAX_TAGS = 0.5
"""Largest share of different tags among the rows of a sample."""


class LongFormat(NamedTuple):
    """Columns of a long table.

    Attributes:
        time: the time column.
        tag: number of the column of tags.
        value: number of the column of values.
        quality: number of the column of qualities; None: there is none.
    """

    time: TimeColumn
    tag: int
    value: int
    quality: int | None


def find_long_format(layout: Layout, stated: FileFormat, names: Collection[str]) -> LongFormat | None:
    """Find the columns of a long table; None if the table is wide.

    Args:
        layout: the table.
        stated: statements of the user.
        names: columns that are asked for; a table that has one is wide.
    """
    headers = {*layout.names, *map(bare_name, layout.names)}
    columns = range(len(layout.names))
    if headers & {name for name in names if not name.isdigit()} or not 3 <= len(columns) <= 7 or not layout.sample:
        return None
    texts = [column for column in columns if layout.kinds[column] == TEXT and _repeats(layout.cells(column))]
    tag = next((column for column in texts if _TAG.search(layout.names[column])), None)
    if tag is None and layout.header_row is None:
        tag = next(iter(texts), None)
    if tag is None:
        return None
    qualities = [column for column in columns if _QUALITY.search(layout.names[column]) and column != tag]
    numbers = [column for column in columns if layout.kinds[column] == NUMBER and column not in qualities]
    value = next((column for column in numbers if _VALUE.search(layout.names[column])), None)
    time = choose_time(layout, stated, [column for column in (tag, value, *qualities) if column is not None])
    rest = [column for column in numbers if column not in time.columns]
    value = value if value is not None else rest[-1] if len(rest) == 1 else None
    return None if value is None or not time.columns else LongFormat(time, tag, value, next(iter(qualities), None))


class TagSeries(NamedTuple):
    """Times and values of a tag, each of shape (rows of the tag,)."""

    times: NDArray[np.float64] | NDArray[np.int64]
    values: NDArray[np.float64]


def read_tags(
    layout: Layout, long: LongFormat, stated: FileFormat, wanted: Collection[str] | None
) -> tuple[dict[str, TagSeries], bool, list[str]]:
    """Read the series of each tag.

    Args:
        layout: the table.
        long: columns of the table.
        stated: statements of the user.
        wanted: tags to read; None: all.

    Returns:
        The series by tag in the order of their first rows; whether their times are clock times in nanoseconds since
        1970; and the guesses, for people.

    Raises:
        InputError: a cell of a tag that is read is no time or no number.
    """
    texts = [long.tag, long.value, *([] if long.quality is None else [long.quality])]
    stamps = long.time.pattern is not None
    numbers = [] if stamps else list(long.time.columns)
    table = TextTable(layout, numbers, [*texts, *(long.time.columns if stamps else ())])
    tags = table.texts(long.tag).dictionary_encode()
    index = np.asarray(tags.indices.fill_null(-1))
    series: dict[str, TagSeries] = {}
    is_clock, notes = False, [""]
    for number, cell in enumerate(tags.dictionary.to_pylist()):
        tag = cell.strip()
        if not tag or (wanted is not None and tag not in wanted and bare_name(tag) not in wanted):
            continue
        part = table.select(np.flatnonzero(index == number))
        found = read_times(part, long.time, stated)
        values, is_clock, notes = part.numbers(long.value), found.is_clock, found.notes
        if long.quality is not None:
            good = [_GOOD.match(text or "") is not None for text in part.texts(long.quality).to_pylist()]
            values = np.where(good, values, np.nan)
        if not found.valid.all():
            part.refuse(int(np.flatnonzero(~found.valid)[0]), long.time.columns[0], "expected a time")
        series[tag] = TagSeries(found.values, values)
    if not series:
        known = [cell.strip() for cell in tags.dictionary.to_pylist()]
        hints = dict.fromkeys(hint_at_closest(name, known) for name in wanted or ())
        raise InputError(
            f"{layout.path}: expected rows of the tags {', '.join(map(repr, wanted or ()))}, "
            f"got {', '.join(map(repr, known[:20]))}{''.join(hints)}"
        )
    names = [layout.names[column] for column in (long.tag, long.value)]
    return series, is_clock, [*notes, f"a row for each value of `{names[1]}` by `{names[0]}`"]


def _repeats(cells: list[str]) -> bool:
    return len(set(cells)) <= MAX_TAGS * len(cells)
