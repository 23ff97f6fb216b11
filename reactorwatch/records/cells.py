"""Cells of a table: their kinds, and their conversion to numbers."""

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
_UNCERTAIN = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
"""A decimal comma, or a thousand."""


def kind_of(cell: str, missing: frozenset[str] = frozenset(MISSING)) -> str:
    """Kind of a cell: number, time, empty (not measured) or text."""
    text = cell.strip()
    if text in missing:
        return EMPTY
    if any(form.fullmatch(text) for form in _FORMS):
        return NUMBER
    return TIME if guess_pattern([text]) is not None else TEXT


def guess_decimal(cells: list[str]) -> str | None:
    """Decimal sign of numbers; None if `1,234` may be both a decimal comma and a thousand in all of them."""
    texts = [cell.strip() for cell in cells if "," in cell]
    if any(_GROUPS_OF["."].fullmatch(text) and "." in text for text in texts):
        return "."
    numbers = [text for text in texts if any(form.fullmatch(text) for form in (_COMMA, _GROUPS_OF[","], _GAPS))]
    if not numbers:
        return "."
    if any(not _UNCERTAIN.fullmatch(text) for text in numbers):
        return ","
    with_point = any("." in cell and _POINT.fullmatch(cell.strip()) for cell in cells)
    return "." if with_point else None


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
