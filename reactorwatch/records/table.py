"""Layout of a text table, and its columns as pyarrow parses them."""

import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError, hint_at_closest
from reactorwatch.records.cells import EMPTY, NUMBER, TEXT, find_sentinels, kind_of, to_numbers
from reactorwatch.units import is_unit

_SEPARATORS = {",": "comma separated", "\t": "tab separated", " ": "blank separated"}
_WORD = re.compile(r"[^\W\d_]{2}")
_BRACKETED = re.compile(r"\s*[\[(]([^\[\]()]+)[\])]\s*$")
_LABELLED = re.compile(r"\s+(?:/|in)\s+([^\s\[\]]+)\s*$")
"""A unit after a name, as ISO 80000-1 writes it in tables (`T / K`), and in words."""

COMMENT = re.compile(rb"^[ \t]*(?:#(?!N/A|NV\b|DIV/0!|[A-Z]+[!?])|%|//)[^\n]*", re.MULTILINE)
"""A comment without its line end: it is replaced by a blank line, so that line numbers stay."""


@dataclass(frozen=True)
class Layout:
    """Text of a table and its layout.

    Attributes:
        path: the file, for messages.
        text: the whole text, UTF-8; comments are blank lines, runs of blanks are one if they separate.
        separator: the character between cells.
        decimal: the decimal sign.
        names: name of each column, without blanks around it; without a header its number.
        units: unit of each column, from a row of units or in brackets in the name; empty: unknown.
        header_row: number of the line with the names, as a text editor counts; None: no header.
        first_row: number of the first line of data.
        sample: cells of the first rows, each of the table's width.
        missing: cells that mean "not measured".
        notes: what is unusual, for people.
        transposed: the file's rows and columns were exchanged.
    """

    path: Path
    text: bytes
    separator: str
    decimal: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    header_row: int | None
    first_row: int
    sample: list[list[str]]
    missing: frozenset[str]
    notes: list[str] = field(default_factory=list)
    transposed: bool = False

    def find(self, name: str, *, by_number: bool = True) -> int | None:
        """Index of a column by its header, its name without unit or its number from 1; None: none, or several."""
        for positions in self._positions:
            if len(found := positions.get(name, [])) == 1:
                return found[0]
        is_number = by_number and name.isdecimal() and 1 <= int(name) <= len(self.names)
        return int(name) - 1 if is_number else None

    @cached_property
    def _positions(self) -> tuple[dict[str, list[int]], ...]:
        """Indices of the columns of each header, and of each name without unit."""
        headers: dict[str, list[int]] = {}
        bare: dict[str, list[int]] = {}
        for index, name in enumerate(self.names):
            headers.setdefault(name, []).append(index)
            bare.setdefault(bare_name(name), []).append(index)
        return headers, bare

    def describe_names(self, name: str) -> str:
        """Names of the columns, with a hint at that which is closest to a name that was not found."""
        return ", ".join(map(repr, self.names)) + hint_at_closest(name, map(bare_name, self.names))

    def cells(self, column: int) -> list[str]:
        """Cells of a column in the sample."""
        return [row[column] for row in self.sample]

    @cached_property
    def kinds(self) -> tuple[str, ...]:
        """Kind of most cells of each column in the sample."""
        found = []
        for column in range(len(self.names)):
            kinds = Counter(kind_of(cell, self.missing) for cell in self.cells(column))
            kinds.pop(EMPTY, None)
            found.append(kinds.most_common(1)[0][0] if kinds else EMPTY)
        return tuple(found)

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Yield rows of data, each with the number of its last line; for messages."""
        lines = self.text.decode().rstrip("\n").split("\n")[self.first_row - 1 :]
        reader = csv.reader((f"{line}\n" for line in lines), delimiter=self.separator, strict=True)
        while True:
            try:
                cells = next(reader, None)
            except csv.Error as error:
                row = self.first_row - 1 + reader.line_num
                kind = describe_separator(self.separator)
                raise InputError(f"{self.path}, row {row}: expected {kind} cells: {error}") from error
            if cells is None:
                return
            if len(cells) > 1 or (cells and cells[0].strip() and not (len(self.names) > 1 and is_remark(cells[0]))):
                yield self.first_row - 1 + reader.line_num, cells


def is_remark(line: str) -> bool:
    """True for a line without separators that is a text, such as the number of rows below them.

    >>> is_remark("240 rows selected"), is_remark("2026-03-01T08:0")
    (True, False)
    """
    return _WORD.search(line) is not None and kind_of(line) == TEXT


def blank_repeats(layout: Layout) -> tuple[bytes, int]:
    """Text with blank lines in place of repeats of the header, as in files put together, and their number."""
    lines = layout.text.split(b"\n", layout.first_row - 1)
    head, rest = lines[:-1], b"\n" + lines[-1]
    row = layout.header_row or 0  # in a comment, a header may stand below the rows
    header = head[row - 1] if 0 < row <= len(head) else b""
    repeats = rest.count(b"\n" + header + b"\n") if header.strip() else 0
    if not repeats:
        return layout.text, 0
    return b"\n".join(head) + rest.replace(b"\n" + header + b"\n", b"\n\n"), repeats


def bare_name(name: str) -> str:
    """Name without the unit at its end.

    >>> [bare_name(name) for name in ("T [K]", "T / K", "T in degC", "Flow in pipe")]
    ['T', 'T', 'T', 'Flow in pipe']
    """
    match = _unit_in(name)
    return name if match is None else name[: match.start()].strip() or name


def unit_of_name(name: str) -> str:
    """Unit at the end of a name, in brackets or after `/` or `in`; empty if there is none."""
    match = _unit_in(name)
    return match[1].strip() if match else ""


def _unit_in(name: str) -> "re.Match[str] | None":
    match = _BRACKETED.search(name)
    if match is None:
        match = _LABELLED.search(name)
        if match is not None and not is_unit(match[1]):
            return None
    return match


def describe_separator(separator: str) -> str:
    """Separator for people.

    >>> describe_separator(";")
    '; separated'
    """
    return _SEPARATORS.get(separator, f"{separator} separated")


def split_line(line: str, separator: str) -> list[str]:
    """Cells of a line; runs of blanks separate once."""
    lines = [" ".join(line.split())] if separator == " " else line.splitlines(keepends=True)
    return next(csv.reader(lines, delimiter=separator), [""])


BLOCK_BYTES = 1 << 22  # a smaller file is not worth a second thread
_MISSING_CURE = "--missing {} reads it as not measured"


def _to_numpy(cells: Any) -> NDArray[np.float64]:
    """Values of a pyarrow column of numbers, NaN where null. Its `to_numpy` would import pandas, which takes long."""
    values, begin = np.empty(len(cells)), 0
    for chunk in cells.chunks:
        valid, stored = chunk.buffers()
        rows, part = slice(chunk.offset, chunk.offset + len(chunk)), values[begin : begin + len(chunk)]
        part[:] = np.frombuffer(stored or b"", np.float64)[rows]
        if valid is not None:
            part[np.unpackbits(np.frombuffer(valid, np.uint8), bitorder="little")[rows] == 0] = np.nan
        begin += len(chunk)
    return values


class TextTable:
    """Columns of a table, by number from 0."""

    def __init__(self, layout: Layout, numbers: Sequence[int], texts: Sequence[int] = ()) -> None:
        import pyarrow as pa

        self.layout = layout
        self._repeats, self._remarks = 0, list[str]()
        if not numbers:  # among texts, a repeat of the header would be a row
            text, self._repeats = blank_repeats(layout)
            self.layout = replace(layout, text=text)
        self._body = find_body(self.layout)
        if not layout.sample and not bytes(self._body).strip():
            raise InputError(f"{layout.path}: expected rows below the header, got none")
        try:
            self._table = self._parse(dict.fromkeys(map(str, numbers), pa.float64()), texts)
        except pa.ArrowInvalid:  # some cells are no plain numbers, a row is too short, or there are comments
            text, self._repeats = blank_repeats(layout)
            self.layout = replace(layout, text=COMMENT.sub(b"", text))
            self._body = find_body(self.layout)
            try:
                self._table = self._parse({}, [*numbers, *texts])
            except pa.ArrowInvalid as error:
                self._refuse_row(error)
        self._sentinels = find_sentinels(layout.missing)
        self._known: dict[int, NDArray[np.float64]] = {}
        self._chosen: NDArray[np.intp] | None = None

    @property
    def notes(self) -> list[str]:
        """Lines that are no rows and were left out, for people."""
        notes = [f"repeated headers left out: {self._repeats}"] if self._repeats else []
        if self._remarks:
            notes.append(f"lines of text left out: {len(self._remarks)}, such as `{self._remarks[0]}`")
        return notes

    @property
    def rows(self) -> int:
        """Number of rows."""
        return int(self._table.num_rows)

    @property
    def first_row(self) -> int | None:
        """Number of the first row in the file, as a text editor counts; None: lines between the rows are blank."""
        text = np.frombuffer(self.layout.text, dtype=np.uint8)  # bytes.count takes three times as long
        blocks = (text[start : start + BLOCK_BYTES] for start in range(0, text.size, BLOCK_BYTES))
        ends = sum(int(np.count_nonzero(block == ord("\n"))) for block in blocks)
        lines = ends - self.layout.text.endswith(b"\n") + 2 - self.layout.first_row
        is_whole = self._chosen is None and lines == self.rows
        return self.layout.first_row if is_whole and not self.layout.transposed else None

    def select(self, rows: NDArray[np.intp]) -> "TextTable":
        """Some of the rows."""
        part = copy(self)
        part._table, part._known, part._chosen = self._table.take(rows), {}, rows
        return part

    def numbers(self, column: int, rule: str = "expected a finite number or nothing") -> NDArray[np.float64]:
        """Numbers in a column, shape (rows,); NaN: not measured."""
        if column not in self._known:
            cells = self._table.column(str(column))
            if str(cells.type) == "double":
                values = _to_numpy(cells)
            else:
                text = cells.combine_chunks()
                values, bad = to_numbers(text, self.layout.decimal, self.layout.missing)
                if bad is not None:
                    is_number = kind_of(text[bad].as_py()) == NUMBER
                    cure = "state --decimal if its sign is another" if is_number else _MISSING_CURE
                    self.refuse(bad, column, rule, cure)
            if self._sentinels:
                values = np.where(np.isin(values, self._sentinels), np.nan, values)
            self._known[column] = values
        return self._known[column]

    def texts(self, column: int) -> Any:
        """Cells of a column that was kept as text: a pyarrow array of strings, shape (rows,)."""
        return self._table.column(str(column)).combine_chunks()

    def refuse(self, row: int, column: int, rule: str, cure: str = "") -> NoReturn:
        """Refuse a cell."""
        row = row if self._chosen is None else int(self._chosen[row])
        line, cells = next(item for index, item in enumerate(self.layout.rows()) if index == row)
        at = f"{self.layout.path}, row {line}, column {self.layout.names[column]!r}"
        if self.layout.transposed:
            at = f"{self.layout.path}, row {self.layout.names[column]!r}, column {line}"
        raise InputError(f"{at}: {rule}, got {cells[column]!r}{f'; {cure.format(cells[column])}' if cure else ''}")

    def _parse(self, types: dict[str, Any], texts: Sequence[int]) -> Any:
        import pyarrow as pa
        import pyarrow.csv

        layout = self.layout
        names = [str(column) for column in range(len(layout.names))]
        kept = {str(column): pa.string() for column in texts}
        self._remarks.clear()
        return pyarrow.csv.read_csv(
            pa.BufferReader(self._body),
            read_options=pyarrow.csv.ReadOptions(
                column_names=names,
                block_size=BLOCK_BYTES,
                use_threads=len(self._body) > BLOCK_BYTES,  # a thread that has just started can abort the exit
            ),
            parse_options=pyarrow.csv.ParseOptions(
                delimiter=layout.separator,
                newlines_in_values=b'"' in layout.text,
                invalid_row_handler=self._skip_remark,
            ),
            convert_options=pyarrow.csv.ConvertOptions(
                column_types={**types, **kept},
                include_columns=[*types, *kept],
                null_values=sorted(layout.missing),
                decimal_point=layout.decimal,
            ),
        )

    def _skip_remark(self, row: Any) -> str:
        """Decide about a row with another number of cells than the header."""
        if row.text.strip() and not (row.actual_columns == 1 and is_remark(row.text)):
            return "error"
        self._remarks += [row.text.strip()] if row.text.strip() else []
        return "skip"

    def _refuse_row(self, error: Exception) -> NoReturn:
        """Find the row that pyarrow cannot split."""
        width = len(self.layout.names)
        for line, cells in self.layout.rows():
            if len(cells) != width:
                expected = f"{width} cells{' as in the header' if self.layout.header_row else ''}"
                raise InputError(f"{self.layout.path}, row {line}: expected {expected}, got {len(cells)}") from error
        kind = describe_separator(self.layout.separator)
        raise InputError(f"{self.layout.path}: expected {kind} cells: {str(error).partition(chr(10))[0]}") from error


def find_body(layout: Layout) -> Any:
    """Buffer of the lines from the first row on, without line ends at the end."""
    import pyarrow as pa

    text, start, end = layout.text, 0, len(layout.text)
    for _ in range(layout.first_row - 1):
        start = text.find(b"\n", start) + 1 or len(text)
    while end > start and text[end - 1] == ord("\n"):
        end -= 1
    return pa.py_buffer(text).slice(start, end - start)
