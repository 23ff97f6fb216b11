"""Layout of a text table: separator, decimal sign, names, units, first row."""

import csv
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from reactorwatch.errors import InputError, hint_at_closest
from reactorwatch.records.cells import EMPTY, TEXT, kind_of
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
        """Yield rows of data, each with the number of its last line; for messages.

        Raises:
            InputError: a quoted cell has no end.
        """
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
