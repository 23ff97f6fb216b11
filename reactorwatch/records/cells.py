"""Cells of a table: their kinds, their conversion to numbers, decimal sign and codes that mean "not measured"."""

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.records.timestamps import guess_pattern

_WORDS = """
|-|--|---|----|-----|?|*|***|NA|N/A|N.A.|n/a|n.a.|na
|#N/A|#NV|nan|NaN|NAN|-nan|-NaN|1.#QNAN|-1.#IND|null|NULL|None|none|missing
|Bad|BAD|bad|Error|ERROR|error|Invalid|INVALID|invalid
|Bad Input|Bad Data|No Data|No Result|I/O Timeout|Comm Fail|Calc Failed|Not Connect|Pt Created
|Scan Off|Shutdown|Intf Shut|Under Range|Over Range|Arc Off-line|Out of Serv|Configure
|#VALUE!|#DIV/0!|#REF!|#NUM!|#WERT!|#BEZUG!|#ZAHL!"""
MISSING = tuple(word.strip() for word in _WORDS.split("|"))
"""Cells of historians and spreadsheets that mean: not measured."""


NUMBER, TIME, EMPTY, TEXT = "number", "time", "empty", "text"
_DIGITS = r"(?:\d+\.?\d*|\.\d+)"
_POINT = re.compile(rf"[+-]?{_DIGITS}(?:[eE][+-]?\d+)?")
_COMMA = re.compile(r"[+-]?(?:\d+,\d+|,\d+)(?:[eE][+-]?\d+)?")
_GROUPS_OF = {
    ",": re.compile(r"[+-]?\d{1,3}(?:\.\d{3})+(?:,\d+)?"),
    ".": re.compile(r"[+-]?\d{1,3}(?:,\d{3})+(?:\.\d+)?"),
}
"""Numbers with thousands in groups, by decimal sign."""
_GAP = "[ '\u2019\u00a0\u202f]"
_GAPS = re.compile(rf"[+-]?\d{{1,3}}(?:{_GAP}\d{{3}})+(?:[.,]\d+)?")
"""Numbers with thousands in groups, by a sign that is no decimal sign."""
_FORMS = (_POINT, _COMMA, *_GROUPS_OF.values(), _GAPS)
_EXPONENT = r"(?:[eE][+-]?\d+)"


def kind_of(cell: str, missing: frozenset[str] = frozenset(MISSING)) -> str:
    """Kind of a cell: number, time, empty (not measured) or text."""
    text = cell.strip()
    if text in missing:
        return EMPTY
    if any(form.fullmatch(text) for form in _FORMS):
        return NUMBER
    return TIME if guess_pattern([text]) is not None else TEXT


def find_decimal(text: Any, separator: str) -> tuple[str | None, int]:
    """Find the decimal sign of a table by all its cells, up to the first one with a sign that cannot group thousands.

    In `963` and `1.007` the sign is open; in `0.963`, `1.07` and `1.234,5` it is not. A table that is separated by
    commas has decimal points, unless cells in quotes hold commas.

    Args:
        text: the rows, a buffer of UTF-8.
        separator: the character between cells.

    Returns:
        The decimal sign, None if it is open; and the index of the byte at which the first cell with a sign starts.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    certain, every = {}, []
    for sign, group in (".,", ",."):
        own, other, gap = re.escape(sign), re.escape(group), _GAP.replace(separator, "")
        millions, open_form = rf"\d{{1,3}}(?:{other}\d{{3}}){{2,}}", rf"[1-9]\d{{0,2}}{own}\d{{3}}"
        form = (
            rf"(?:0\d*|\d{{4,}})?{own}\d+{_EXPONENT}?|\d+{own}(?:\d\d?|\d{{4,}}){_EXPONENT}?|\d+{own}\d+{_EXPONENT}"
            rf"|\d{{1,3}}(?:{other}\d{{3}})+{own}\d+|\d{{1,3}}(?:{gap}\d{{3}})+{own}\d+|{millions}"
        )
        if sign == ".":
            form += rf"|\d+\.|{open_form}" if separator == "," else r"|\d+\."
        certain[sign] = _cell(form, millions if sign == separator else form, separator)
        every += [certain[sign], _cell(open_form, millions if sign == separator else open_form, separator)]

    def search(patterns: Iterable[str], begin: int) -> int:
        """Index of the first cell of a form: in one string, which RE2 searches at 500 MB/s; -1: there is none."""
        offsets = pa.py_buffer(np.array([begin, text.size], dtype=np.int64))
        index = pc.find_substring_regex(pa.LargeStringArray.from_buffers(1, offsets, text), "|".join(patterns))
        return begin + index[0].as_py() if index[0].as_py() >= 0 else -1

    first = search(every, 0)
    known = search(certain.values(), first) if first >= 0 else -1
    if known < 0:
        return "." if first < 0 else None, first
    cell = text.slice(known, min(80, text.size - known)).to_pybytes().decode(errors="ignore")  # longer ones are texts
    return next(sign for sign, form in certain.items() if re.match(form, cell)), first


def _cell(quoted: str, bare: str, separator: str) -> str:
    """Regular expression of RE2 and Python for a cell with or without quotes, with the signs around it."""
    edge = rf"[\n{re.escape(separator)}]"
    return rf'"[ \t]*[+-]?(?:{quoted})[ \t]*"|(?:^|{edge})[ \t]*[+-]?(?:{bare})[ \t]*(?:{edge}|$)'


def to_numbers(cells: Any, decimal: str, missing: frozenset[str]) -> tuple[NDArray[np.float64], int | None]:
    """Convert cells to numbers.

    Args:
        cells: strings, a pyarrow array of shape (rows,); null: not measured.
        decimal: the decimal sign.
        missing: cells that mean "not measured".

    Returns:
        The numbers, NaN where not measured, and the first row that holds no number; None: all rows do.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    text = pc.utf8_trim_whitespace(cells)
    text = pc.if_else(pc.is_in(text, pa.array(sorted(missing))), None, text)
    group, sign = (".", ",") if decimal == "," else (",", ".")
    grouped = pc.match_substring_regex(text, f"^{_GROUPS_OF[sign].pattern}$")
    text = pc.if_else(grouped, pc.replace_substring(text, group, ""), text)
    gaps = pc.match_substring_regex(text, f"^{_GAPS.pattern}$")
    text = pc.if_else(gaps, pc.replace_substring_regex(text, _GAP, ""), text)
    if decimal == ",":
        text = pc.if_else(pc.match_substring(text, "."), "x", pc.replace_substring(text, ",", "."))
    good = pc.fill_null(pc.match_substring_regex(text, f"^{_POINT.pattern}$"), fill_value=True)
    numbers = pc.cast(pc.if_else(good, text, None), pa.float64())
    values = np.array(numbers.to_numpy(zero_copy_only=False), dtype=np.float64)
    bad = np.flatnonzero(~np.asarray(good))
    return values, int(bad[0]) if bad.size else None


def find_sentinels(missing: frozenset[str]) -> list[float]:
    """Numbers among the cells that mean "not measured".

    >>> find_sentinels(frozenset({"NA", "-999"}))
    [-999.0]
    """
    return [float(cell.replace(",", ".")) for cell in missing if _POINT.fullmatch(cell) or _COMMA.fullmatch(cell)]


_CODE = re.compile(r"-9+(\.9+)?|999+|-?(32767|32768|65535|2147483647|2147483648|4294967295|1e\+?\d\d|10{9,14})")
"""Nines, limits of integers, large powers of ten; 99 and 99.9 are values of a saturated input, -9 is any number."""


def describe_sentinels(columns: Mapping[str, Array]) -> list[str]:
    """Notes on the probable sentinels of signals, each with the option that excludes it.

    A known code is so far from the other values as these are from each other. Any other value repeats at least three
    times, is 20 times as far and 10 times as large, and none at which sound inputs stand, closed or fully open.
    """
    rows: dict[str, list[str]] = {}
    for name, values in columns.items():
        finite = values[np.isfinite(values)]
        if not finite.size or max(np.count_nonzero(finite == end) for end in (finite.min(), finite.max())) < 2:
            continue  # as mostly; sorting takes longer
        found, counts = np.unique(finite, return_counts=True)
        repeated = np.flatnonzero((counts > 1) & (np.abs(found) > 1.0)).tolist()
        codes = [i for i in repeated if found[i] != -9.0 and _CODE.fullmatch(f"{found[i]:.15g}")]
        for i in repeated:
            value, others = float(found[i]), np.delete(found, [i, *codes])
            if others.size < 10:  # modes, or the steps of an actuator
                continue
            low, high = float(others[0]), float(others[-1])
            distance, size = max(low - value, value - high), max(abs(low), abs(high))
            is_far = distance > 20.0 * (high - low) and abs(value) > 10.0 * size and counts[i] > 2
            if distance > high - low if i in codes else is_far and abs(value) != 100.0:
                rows.setdefault(f"{value:.15g}", []).append(f"{counts[i]} rows of {name}")
    return [
        f"{value} is probably no measurement but a code, in {', '.join(of)} (--missing {value} excludes it)"
        for value, of in rows.items()
    ]
