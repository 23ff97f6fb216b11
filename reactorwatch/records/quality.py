"""Qualities of values, in words and codes as OPC UA, OPC DA, PI, InSQL and Seeq write them."""

import re
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.cells import MISSING, TEXT
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.layout import Layout, bare_name
from reactorwatch.records.text_table import TextTable

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
_VALUE = re.compile(r"values?|messwert|wert", re.IGNORECASE)
_SURE = re.compile(r"good|gut", re.IGNORECASE)

_UA = 0x4000_0000
"""Lowest code of OPC UA that is not good (Part 4, 7.39: the two highest bits are the severity)."""
_DA = 0xC0
"""Bits of a good value in OPC DA (Custom Interface 3.00, 6.8): 192 to 255."""
_DA_BAD = frozenset((500, 504, 505))
"""Codes with these bits that are not good: stale (Ignition), no number and no row (InSQL)."""
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
            of = [item for item in of if base in (_key(_VALUE.sub("", names[item])), _key(names[item]))]
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
        return {code: code & _DA == _DA and code not in _DA_BAD for code in codes} if is_whole else {}
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
