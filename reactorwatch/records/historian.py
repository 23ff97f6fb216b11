"""Exports of historians: tables with a row for each value, and qualities of values."""

import re
from collections.abc import Collection, Mapping, Sequence
from itertools import combinations, pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError, hint_at_closest
from reactorwatch.records.cells import MISSING, NUMBER, TEXT, to_numbers
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.table import Layout, TextTable, bare_name
from reactorwatch.records.times import TimeColumn, choose_time, counts_rows, read_times

_GOOD = {"good", "ok", "okay", "valid", "gut", "gültig", "gueltig", "io", "inordnung"}
_BAD_WORDS = """
bad uncertain questionable suspect suspicious doubtful invalid poor unreliable stale error fault faulty failure failed
fail missing timeout disconnected unknown untrusted schlecht unsicher fraglich fragwürdig zweifelhaft ungültig ungueltig
fehler fehlerhaft gestört gestoert störung stoerung ausfall defekt veraltet unbekannt nio"""
_BAD = frozenset(_BAD_WORDS.split())
_NO = frozenset(["no", "not", "non", "nicht", "kein", "keine", "ohne"])
_NEUTRAL = _NO | frozenset(["opc", "ih", "is", "quality", "qualität", "status", "code", "data", "value"])
"""Words that may stand before that which decides."""
_TRUE, _FALSE = frozenset(["true", "yes", "ja", "wahr"]), frozenset(["false", "no", "nein", "falsch"])

_PARTS = re.compile(r"[A-ZÄÖÜ]?[a-zäöüß]+|[A-ZÄÖÜ]+(?![a-zäöüß])")
_CODE = re.compile(r"([+-]?\d+|0[xX][0-9A-Fa-f]+)(?:[.,]0)?")
_HEX = re.compile(r"0[xX][0-9A-Fa-f]+")
_STRONG = re.compile(
    r"(?:opc|data|daten|mess|wert)?[\W_]*qual(?!\w*rule)(?:ity|ität|itaet|ité)?(?:[\W_]*(?:code|detail|flag|status|good))?",
    re.IGNORECASE,
)
_WEAK = re.compile(
    r"status(?:[\W_]*code)?|questionable|(?:is)?[\W_]*(?:good|valid)(?:ity)?\b|gültig(?:keit)?|confidence"
    r"|data_?integrity",
    re.IGNORECASE,
)
_FLAG = re.compile(r"(?<=[\W_])(?:flag|qc?)$|^flag$", re.IGNORECASE)
_VALUE_WORD = re.compile(r"values?|messwert|wert", re.IGNORECASE)
_SURE = re.compile(r"good|gut", re.IGNORECASE)

_UA = 0x4000_0000
"""Lowest code of OPC UA that is not good (Part 4, 7.39: the two highest bits are the severity)."""
_DA = 0xC0
"""Bits of a good value in OPC DA (Custom Interface 3.00, 6.8): 192 to 255."""
_INSQL = {0: True, 1: False, 16: False, 133: True}
"""Codes of InSQL's column `Quality`."""


def is_quality_name(name: str) -> bool:
    """True for the header of a column that may hold qualities."""
    return (_STRONG.search(name) or _WEAK.search(name)) is not None


def find_qualities(
    layout: Layout, columns: Collection[int], stated: FileFormat, values: Collection[int] | None = None
) -> dict[int, list[int]]:
    """Columns of values by their column of qualities; without `values` a table has a row for each value."""
    found: dict[int, list[int]] = {}
    names = [bare_name(name) for name in layout.names]
    for column in columns:
        name, is_text = names[column], layout.kinds[column] == TEXT
        if values is None:
            if is_quality_name(name) or (is_text and _is_certain(layout, column, stated)):
                found[column] = []
            continue
        base = _key(_FLAG.sub("", _WEAK.sub("", _STRONG.sub("", name))))
        of = [item for item in values if item != column]
        if base:
            of = [item for item in of if base in (_key(_VALUE_WORD.sub("", names[item])), _key(names[item]))]
        elif names.count(name) > 1:  # a column of qualities behind each of values
            of = [item for item in of if item < column and names[item] != name][-1:]
        is_named = _STRONG.search(name) is not None  # numbers that are no codes are a measured quality
        is_named &= all(_code(cell) is not None or is_text for cell in layout.cells(column) if cell.strip())
        is_quality = is_quality_name(name) or _FLAG.search(name) is not None
        if of and is_quality and (is_named or _is_certain(layout, column, stated)):
            found[column] = of
    return found


def check_stated(layout: Layout, found: Collection[int], stated: FileFormat) -> None:
    """Check that there are columns of qualities if good ones are stated.

    Raises:
        InputError: there is none.
    """
    if stated.quality_good and not found:
        raise InputError(
            f"{layout.path}, row {layout.header_row or layout.first_row}: expected a column of qualities "
            f"(--quality-good), such as 'Quality', got {', '.join(map(repr, layout.names))}"
        )


def _is_certain(layout: Layout, column: int, stated: FileFormat) -> bool:
    """True if the first cells are qualities whatever the header: the state of a machine is none."""
    name = layout.names[column]
    known = judge([cell for cell in layout.cells(column) if cell.strip()], name, stated, layout.names)
    good = [cell for cell, is_good in known.items() if is_good]
    if stated.quality_good:
        return bool(good) and "*" not in stated.quality_good
    hint = name if is_quality_name(name) or _FLAG.search(name) else ""
    return None not in known.values() and any(_SURE.search(cell + hint) or (hint and cell.isdecimal()) for cell in good)


class QualityFilter:
    """Removal of values whose quality is not good.

    Args:
        table: the table, which has the columns of qualities as texts.
        columns: columns of values by their column of qualities; empty: all.
        stated: statements of the user.

    Raises:
        InputError: a quality is neither known nor stated, or none is good.
    """

    def __init__(self, table: TextTable, columns: Mapping[int, Collection[int]], stated: FileFormat) -> None:
        self.columns, self._names = columns, table.layout.names
        self._good = {column: _read_quality(table, column, stated) for column in columns}
        self._counts = {column: [0, 0] for column in columns}

    def keep_good(
        self, column: int, values: NDArray[np.float64], rows: NDArray[np.intp] | slice = slice(None)
    ) -> NDArray[np.float64]:
        """Values of some rows of a column, NaN where a quality is not good."""
        known, kept = np.isfinite(values), values
        for quality, good in self._good.items():
            if column in (self.columns[quality] or [column]):
                kept = np.where(good[rows], kept, np.nan)
                self._counts[quality][0] += int(np.count_nonzero(known & ~good[rows]))
                self._counts[quality][1] += int(np.count_nonzero(known))
        return kept

    @property
    def notes(self) -> list[str]:
        """Number of the values that each column excludes, for people."""
        return [
            f"quality `{self._names[column]}` excludes {excluded} of {known} values"
            for column, (excluded, known) in self._counts.items()
        ]


def _read_quality(table: TextTable, column: int, stated: FileFormat) -> NDArray[np.bool_]:
    """True for rows whose quality is good, shape (rows,)."""
    cells = table.texts(column).dictionary_encode()
    words, index = cells.dictionary.to_pylist(), np.asarray(cells.indices, dtype=np.intp)
    names = table.layout.names
    if not any(word.strip() for word in words):
        return np.ones(table.rows, dtype=bool)
    known = judge(words, bare_name(names[column]), stated, beside=names)
    good: NDArray[np.bool_] = np.array([known[word] is True for word in words])[index]
    unknown = np.flatnonzero(np.array([known[word] is None for word in words])[index])
    usable = "".join([f"{word}," for word in words if known[word] and word.strip()][:3])
    cure = f"state the qualities of usable values, such as --quality-good '{usable}{{}}'; '*' is all"
    if unknown.size:
        row = int(unknown[0])
        rule = "expected a quality that is known as good or not good"
        if _code(words[index[row]]) is not None:
            codes = ", ".join(map(str, sorted({code for word in words if (code := _code(word)) is not None})[:5]))
            rule = f"expected codes that tell OPC DA (192 is good) from OPC UA (0 is good), not only {codes}"
        table.refuse(row, column, rule, cure)
    if not good.any():
        table.refuse(0, column, "expected a good quality in some row", cure)
    return good


def _key(name: str) -> str:
    return re.sub(r"[\W_]", "", name).casefold()


def judge(
    cells: Sequence[str], header: str, stated: FileFormat, beside: Collection[str] = ()
) -> dict[str, bool | None]:
    """Decide over all different cells of a column, with its header and those beside it: the code 0 has two meanings.

    Returns:
        True for good, False for not good, None for unknown, by cell.
    """
    codes = {cell: _code(cell) for cell in cells}
    if stated.quality_good:
        texts = (word for text in stated.quality_good for word in (text, *filter(None, text.split(","))))
        words = {word.strip().casefold() or "empty" for word in texts}
        usable = {_code(word) for word in words} - {None}
        every = "*" in words
        return {cell: every or codes[cell] in usable or (cell.strip().casefold() or "empty") in words for cell in cells}
    sign = _judge_word(header)
    known = {cell: _judge_word(cell) for cell in cells if codes[cell] is None}
    if sign is not None or _STRONG.search(header):
        is_true = sign is not False
        for cell in known:
            word = cell.strip().casefold()
            known[cell] = is_true if word in _TRUE else not is_true if word in _FALSE else known[cell]
    has_word = any(good and cell.strip() for cell, good in known.items())
    numbers = _judge_codes({code for code in codes.values() if code is not None}, header, sign, has_word, beside)
    return {cell: known[cell] if code is None else numbers.get(code) for cell, code in codes.items()}


def _judge_codes(
    codes: set[int], header: str, sign: bool | None, has_word: bool, beside: Collection[str]
) -> dict[int, bool]:
    """Meaning of codes, by code; empty: they can be read in several ways."""
    name = _key(header)
    severe = {code: code & 0xFFFF_FFFF for code in codes}
    if any(_UA <= code < 3 * _UA for code in severe.values()) or "statuscode" in name:
        is_whole = all(code == 0 or 0x400 <= code < 3 * _UA for code in severe.values())
        return {code: value < _UA for code, value in severe.items()} if is_whole else {}
    if any(_DA <= code <= 0xFF for code in codes) or has_word or "opcquality" in name or "detail" in name:
        is_whole = all(0 <= code < _UA for code in codes)
        # Stale (Ignition), no number and no row (InSQL) are not good.
        return {code: code & _DA == _DA and code not in (500, 504, 505) for code in codes} if is_whole else {}
    if sign is not None and codes <= {0, 1}:
        return {code: bool(code) == sign for code in codes}
    is_insql = 133 in codes or any(_key(other) in ("opcquality", "qualitydetail") for other in beside)
    return _INSQL if is_insql and codes <= _INSQL.keys() else {}


def _code(cell: str) -> int | None:
    match = _CODE.fullmatch(cell.strip())
    return None if match is None else int(match[1], 16 if "x" in match[1].lower() else 10)


def _judge_word(cell: str) -> bool | None:
    """True for a word that means good, False for one that does not or an empty cell, None for an unknown one.

    >>> [_judge_word(word) for word in ("GoodLocalOverride", "Bad_NoCommunication", "not good", "n.i.O.", "Anna")]
    [True, False, False, False, None]
    """
    whole = _key(cell)
    words = [whole] if whole in _GOOD | _BAD else [word.casefold() for word in _PARTS.findall(_HEX.sub("", cell))]
    signs = [
        ((word in _GOOD or word.startswith("good")) != (before in _NO), place)
        for place, (before, word) in enumerate(pairwise(["", *words]))
        if word in _GOOD | _BAD or word.startswith(("good", "bad", "uncertain"))
    ]
    if not whole or cell.strip() in MISSING or any(not good for good, _ in signs):
        return False
    return True if signs and set(words[: signs[0][1]]) <= _NEUTRAL else None


_TAG = re.compile(r"tag|point|signal|variable|sensor|channel|mess(?:stelle|punkt)|kanal|name", re.IGNORECASE)
_VALUE = re.compile(r"val|wert|reading|mess(?!.*zeit)", re.IGNORECASE)
_ID = re.compile(rf"{_TAG.pattern}|(?:\b|_)id$|[a-z]I[Dd]$|device", re.IGNORECASE)
"""Headers of tags, and of those that are numbers."""
_UNIT = re.compile(r"unit|uom|einheit", re.IGNORECASE)

SHARED, SORTED, RESTARTING, ALTERNATING, REGULAR = "shared", "sorted", "restarting", "alternating", "regular"
"""Arrangements of rows: several have one time; they are sorted by tag, on a clock, or with minutes that start again as
those of batches do; tags alternate, or so do the labels of rows at regular times."""


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
            value is not None and _variance_share(TextTable(layout, minutes, [value]), value, index) >= 0.9,
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
    rare = 0.1  # share of rows with another tag than the row before, below which each tag has times of its own
    distinct = 0.9  # least share of the steps from a value of a tag to its next at which the time goes on
    changed, steps = np.diff(tags) != 0, np.diff(times)
    changes = float(np.mean(changed)) if changed.size else 0.0
    # Half of the rows at most have a tag of their own.
    if not 1 <= tags.max(initial=0) < 0.5 * tags.size or (changes < rare and (steps > 0).all()):
        return ""  # most wide tables, without sorting
    order = np.argsort(tags, kind="stable")
    inner = np.diff(times[order])[np.diff(tags[order]) == 0]
    if max(np.mean(inner > 0), np.mean(inner < 0)) < distinct:
        return ""
    steps = steps if np.median(inner) > 0 else -steps  # the newest may be first
    if np.mean(steps == 0) >= 1 / 6:  # it is 1/2 for two tags that are sampled together
        return SHARED
    if (steps < 0).any() and changed[steps < 0].all():
        return SORTED if times.dtype.kind == "i" else RESTARTING
    is_regular = np.mean(np.isclose(steps, np.median(steps), rtol=0.1)) > distinct and changes < distinct
    return "" if changes < rare else REGULAR if is_regular else ALTERNATING


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
