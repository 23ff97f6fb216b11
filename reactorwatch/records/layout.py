"""Layout of a text table, guessed from its first lines: separator, header, orientation, decimal sign."""

import csv
import io
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from reactorwatch.errors import InputError
from reactorwatch.records.cells import EMPTY, MISSING, NUMBER, TEXT, TIME, find_decimal, kind_of, to_numbers
from reactorwatch.records.decode import unquote_formula
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.table import (
    COMMENT,
    Layout,
    TextTable,
    describe_separator,
    find_body,
    split_line,
    unit_of_name,
)

HEAD_BYTES = 65_536  # hundreds of lines of most files
HEAD_LINES = 200
"""Lines from which the layout is guessed."""

_SEPARATORS = ";\t,| "
_BLANKS = re.compile(rb"[ \t]+")


def sniff(path: Path, text: bytes, stated: FileFormat) -> Layout:
    """Guess the layout of a table."""
    missing = frozenset((*MISSING, *stated.missing))
    comments = [
        (text.count(b"\n", 0, found.start()) + 1, found[0].decode()) for found in COMMENT.finditer(text, 0, HEAD_BYTES)
    ]
    if comments:
        text = COMMENT.sub(b"", text)
    numbered = [(row, line) for row, line in _head(text) if line.strip(" \t\n")]
    if not numbered:
        raise InputError(f"{path}: expected a header and rows, got only comments")
    separator = stated.separator or _guess_separator([line for _, line in numbered], missing)
    if separator == " ":
        text = b"\n".join(_BLANKS.sub(b" ", line).strip() for line in text.split(b"\n"))
    if separator == stated.decimal == "," and (pairs := _join_pairs(text)):
        layout = sniff(path, pairs, replace(stated, separator=";"))
        return replace(layout, notes=["each two cells are one number", *layout.notes])
    table = [(row, split_line(line, separator)) for row, line in numbered]
    if stated.transposed or (stated.transposed is None and _is_labelled_by_row([cells for _, cells in table], missing)):
        return _transpose(path, text, separator, stated)
    layout = HeaderSearch(path, text, table, separator, stated, missing).layout(comments)
    if stated.transposed is None and _is_unlabelled_by_row(layout):
        return _transpose(path, text, separator, stated)
    return layout


def _head(text: bytes) -> list[tuple[int, str]]:
    """Whole lines at the start of a text, each with its number; lines of one quoted cell are one."""
    size = HEAD_BYTES
    while text.count(b"\n", 0, size) < 12 and size < len(text):  # lines of a transposed file are long
        size *= 4
    lines = text[:size].decode(errors="ignore").split("\n")
    lines = lines[:HEAD_LINES] if size >= len(text) else lines[:-1][:HEAD_LINES]
    found: list[tuple[int, str]] = []
    row = 0
    while row < len(lines):
        ends = range(row + 1, min(row + 5, len(lines)) + 1)  # a cell of a header has a few lines
        end = next((end for end in ends if not "\n".join(lines[row:end]).count('"') % 2), row + 1)
        found.append((end, "\n".join(lines[row:end])))
        row = end
    return found


def _join_pairs(text: bytes) -> bytes | None:
    """Text with `;` between numbers, if each row has twice the header's cells; None if not."""
    lines = [line.split(b",") for line in text.rstrip(b"\n").split(b"\n")]
    if len(lines) < 2 or b'"' in text or any(len(cells) != 2 * len(lines[0]) for cells in lines[1:]):
        return None
    rows = ([b",".join(pair) for pair in zip(cells[::2], cells[1::2], strict=True)] for cells in lines[1:])
    return b"\n".join(b";".join(cells) for cells in (lines[0], *rows))


def _guess_separator(lines: list[str], missing: frozenset[str]) -> str:
    """Separator that splits most of the last lines into as many cells, most of which are values."""
    tail = lines[len(lines) // 4 :]
    scores: list[tuple[bool, float, str]] = []
    for separator in _SEPARATORS:
        rows = [split_line(line, separator) for line in tail]
        width = Counter(map(len, rows)).most_common(1)[0][0]
        regular = [row for row in rows if len(row) == width]
        cells = [cell for row in regular for cell in row] if width > 1 else []
        cells = cells[:: max(1, len(cells) // 1000)]
        values = sum(kind_of(cell, missing) != TEXT for cell in cells) / max(len(cells), 1)
        scores.append((width > 1, round(values * len(regular) / len(rows), 2), separator))
        has_blanks = [kind_of(cell, missing) for cell in cells if " " in cell.strip()]
        if separator == "\t" and len(regular) == len(rows) and has_blanks and TEXT not in has_blanks:
            return separator  # blanks in cells are those between a date and a time of day
    best = max(scores, key=lambda score: score[:2])  # the first of the best
    return best[2] if best[0] else ","


def _is_labelled_by_row(table: list[list[str]], missing: frozenset[str]) -> bool:
    """True if each row starts with a name, or with a name and a unit, and values follow."""
    if len(table) < 2 or len({len(cells) for cells in table}) > 1 or len(table[0]) < 3:
        return False
    labels = [cells[0] for cells in table]
    if len(set(labels)) < len(labels) or any(kind_of(label, missing) != TEXT for label in labels):
        return False
    return all(all(kind_of(cell, missing) != TEXT for cell in cells[2:50]) for cells in table) and any(
        kind_of(cell, missing) in (NUMBER, TIME) for cell in table[0][1:]
    )


def _is_unlabelled_by_row(layout: Layout) -> bool:
    """True if there is no header and the values of each row are more alike than those of each column."""
    if layout.header_row is not None or not layout.sample:
        return False
    width = len(layout.sample[0])
    if width < 10 or layout.text.count(b"\n") >= width:
        return False
    rows = [[kind_of(cell, layout.missing) for cell in cells] for cells in layout.sample]
    if any(kind not in (NUMBER, EMPTY) for kinds in rows for kind in kinds):
        return False
    import pyarrow as pa

    cells = [to_numbers(pa.array(row), layout.decimal, layout.missing)[0] for row in layout.sample]
    values = np.arcsinh(np.array(cells))
    return bool(np.nanvar(np.nanmean(values, axis=1)) > np.nanvar(np.nanmean(values, axis=0)))


def _transpose(path: Path, text: bytes, separator: str, stated: FileFormat) -> Layout:
    """Layout of a table after its rows and columns were exchanged."""
    rows = [split_line(line, separator) for line in text.decode().split("\n") if line.strip()]
    if len({len(cells) for cells in rows}) > 1:
        lengths = sorted({len(cells) for cells in rows})
        raise InputError(f"{path}: expected as many cells in each row to exchange rows and columns, got {lengths}")
    lines = io.StringIO()
    csv.writer(lines, delimiter=separator, lineterminator="\n").writerows(zip(*rows, strict=True))
    layout = sniff(path, lines.getvalue().encode(), replace(stated, transposed=False, separator=separator))
    return replace(layout, transposed=True, notes=[*layout.notes, "rows and columns exchanged"])


_NUMBER = re.compile(rb"[+-]?\d[\d.,]*")


class HeaderSearch:
    """Search for the header and the first row of data."""

    def __init__(
        self,
        path: Path,
        text: bytes,
        table: list[tuple[int, list[str]]],
        separator: str,
        stated: FileFormat,
        missing: frozenset[str],
    ) -> None:
        self._path, self._text, self._table = path, text, table
        self._separator, self._stated, self._missing = separator, stated, missing
        tail = [cells for _, cells in table[len(table) // 4 :]]
        self._width = Counter(map(len, tail)).most_common(1)[0][0]
        columns = zip(*(self._kinds(cells) for cells in tail if len(cells) == self._width), strict=True)
        self._holds_values = [sum(kind in (NUMBER, TIME) for kind in kinds) > len(kinds) / 2 for kinds in columns]

    def _kinds(self, cells: Sequence[str]) -> list[str]:
        return [kind_of(cell, self._missing) for cell in cells]

    def _is_data(self, cells: list[str]) -> bool:
        kinds = self._kinds(cells)
        text = sum(kind == TEXT for kind, values in zip(kinds, self._holds_values, strict=False) if values)
        return len(cells) == self._width and sum(kind in (NUMBER, TIME) for kind in kinds) > text

    def _is_names(self, cells: list[str]) -> bool:
        kinds = self._kinds(cells)
        return TEXT in kinds and NUMBER not in kinds and TIME not in kinds

    def layout(self, comments: list[tuple[int, str]]) -> Layout:
        """Layout of the table."""
        table, stated = self._table, self._stated
        has_numbers = self._is_numbered_header(0)
        data = (index for index, (_, cells) in enumerate(table) if self._is_data(cells))
        first = next((index for index in data if index or not has_numbers), None)
        if first is None:  # nothing but a header
            return self._make([] if stated.header is False else table[:1], 1)
        while first and len(table[first - 1][1]) == self._width and not self._is_names(table[first - 1][1]):
            if set(self._kinds(table[first - 1][1])) <= {EMPTY} or self._is_numbered_header(first - 1):
                break
            first -= 1  # a row of data with bad cells
        heads: list[tuple[int, list[str]]] = []
        while first - len(heads) and len(table[first - len(heads) - 1][1]) == self._width:
            cells = table[first - len(heads) - 1][1]
            if not (self._is_names(cells) or self._is_numbered_header(first - len(heads) - 1)):
                break
            heads.insert(0, table[first - len(heads) - 1])
        if stated.header is False:
            heads, first = [], first - len(heads)
        elif stated.header and not heads:
            heads, first = [table[first]], first + 1
        elif not heads:
            heads = self._unequal_header(first) or self._commented_header(comments)
        return self._make(heads, first)

    def _is_numbered_header(self, index: int) -> bool:
        """True for a first line with names of which some are whole numbers."""
        cells = self._table[index][1]
        kinds = self._kinds(cells)
        numbers = all(cell.strip().isdigit() for cell, kind in zip(cells, kinds, strict=True) if kind == NUMBER)
        text = any(kind == TEXT and values for kind, values in zip(kinds, self._holds_values, strict=False))
        return (
            index == 0 and len(self._table) > 1 and len(cells) == self._width and text and numbers and TIME not in kinds
        )

    def _unequal_header(self, first: int) -> list[tuple[int, list[str]]]:
        """Header with another number of cells than the rows."""
        if not first or len(self._table[first - 1][1]) == 1 or not self._is_names(self._table[first - 1][1]):
            return []
        row, names = self._table[first - 1]
        rows = [cells for _, cells in self._table[first:] if len(cells) == self._width]
        surplus = self._width - len(names)
        if surplus < 0 and not any(name.strip() for name in names[self._width :]):
            return [(row, names[: self._width])]
        if surplus > 0 and not any(cell.strip() for cells in rows for cell in cells[len(names) :]):
            return [(row, [*names, *[""] * surplus])]
        cure = "; if the comma is the decimal sign as well, state --decimal ," if len(names) * 2 == self._width else ""
        raise InputError(
            f"{self._path}, row {self._table[first][0]}: expected {len(names)} cells as in the header, "
            f"got {self._width}{cure}"
        )

    def _commented_header(self, comments: list[tuple[int, str]]) -> list[tuple[int, list[str]]]:
        """Header in the last comment, as NumPy and MATLAB write it."""
        for row, comment in comments[::-1]:
            cells = split_line(comment.strip().lstrip("#%/").strip(), self._separator)
            if len(cells) == self._width and self._is_names(cells):
                return [(row, cells)]
        return []

    def _make(self, heads: list[tuple[int, list[str]]], first: int) -> Layout:
        filled = [sum(bool(cell.strip()) for cell in cells) for _, cells in heads]
        names_index = filled.index(max(filled)) if heads else 0
        heading = map(unquote_formula, heads[names_index][1]) if heads else [""] * self._width
        names = [" ".join(cell.split()) for cell in heading]
        below = heads[names_index + 1 :]
        units_row = min(below, key=lambda head: sum(map(len, head[1]))) if below else None
        units = (
            [cell.strip().strip("[]()") for cell in units_row[1]]
            if units_row
            else [unit_of_name(name) for name in names]
        )
        sample = [cells for _, cells in self._table[first:] if len(cells) == len(names)]
        notes = []
        if self._separator != ",":
            notes.append(describe_separator(self._separator))
        if not heads:
            notes.append("no header")
        elif heads[names_index][0] != self._table[0][0]:
            notes.append(f"header in row {heads[names_index][0]}")
        if units_row:
            notes.append(f"units in row {units_row[0]}")
        layout = Layout(
            path=self._path,
            text=self._text,
            separator=self._separator,
            decimal=self._stated.decimal or ".",
            names=tuple(name or str(number) for number, name in enumerate(names, start=1)),
            units=tuple(units),
            header_row=heads[names_index][0] if heads else None,
            first_row=self._first_line(first),
            sample=sample,
            missing=self._missing,
            notes=notes,
        )
        if self._stated.decimal is None:
            layout = replace(layout, decimal=self._guess_decimal(layout))
        if layout.decimal == ",":
            notes.insert(0 if self._separator == "," else 1, "decimal comma")
        return layout

    def _first_line(self, index: int) -> int:
        """Number of the first line of a row of the head; cells may hold line ends."""
        if index >= len(self._table):
            return self._table[-1][0] + 1
        row, cells = self._table[index]
        return row - sum(cell.count("\n") for cell in cells)

    def _guess_decimal(self, layout: Layout) -> str:
        """Decimal sign, by all rows."""
        body = find_body(layout)
        sign, at = find_decimal(body, layout.separator)
        if sign is None and (group := _find_group_sign(layout)) is not None:
            layout.notes.append(f"thousands grouped by `{group}`")
            sign = "," if group == "." else "."
        if sign is None:
            row = layout.first_row + body.slice(0, at + 1).to_pybytes().count(b"\n")
            cell = _NUMBER.search(body.slice(at).to_pybytes())[0].decode()  # type: ignore[index] # it starts a number
            own, other, name = (".", ",", "point") if "." in cell else (",", ".", "comma")
            raise InputError(
                f"{self._path}, row {row}: {cell!r} may have a decimal {name} (--decimal {own}) or group its thousands "
                f"(--decimal {other}); state one of them, or decimal in [file] of the process's description"
            )
        return sign


def _find_group_sign(layout: Layout) -> str | None:
    """Sign that groups thousands in columns of integers; None: there is no evidence.

    A column that passes from 963 to 1.007 holds integers: its neighbouring cells with and without the sign are within a
    factor of 10 (a decimal sign would make it 1,000), and those without it are below 1,000. Three of these differ: one
    or two may stand for "off" or "out of range".
    """
    import pyarrow.compute as pc

    numbers, texts = (
        [column for column, kind in enumerate(layout.kinds) if kind == wanted] for wanted in (NUMBER, TEXT)
    )
    table = TextTable(layout, [], [*numbers, *texts])
    labels = np.zeros(table.rows, dtype=np.intp)
    for column in texts:  # cells are neighbours if the texts of their rows are the same, such as the tag
        codes = np.asarray(table.texts(column).dictionary_encode().indices)
        labels = np.unique(labels * (codes.max() + 1) + codes, return_inverse=True)[1]
    order, found = np.argsort(labels, kind="stable"), set()
    for column in numbers:
        cells = table.texts(column)
        with_sign = pc.sum(pc.match_substring_regex(cells, "[.,]")).as_py() or 0
        if not 0 < with_sign < table.rows:
            continue
        cells = cells.take(order)
        readings = {sign: to_numbers(cells, sign, layout.missing)[0] for sign in ".,"}
        filled = np.flatnonzero(np.isfinite(readings["."]) & np.isfinite(readings[","]))
        point, comma = readings["."][filled], readings[","][filled]
        group, values = (".", comma) if np.abs(comma).sum() > np.abs(point).sum() else (",", point)
        is_plain = point == comma
        plain = np.unique(values[is_plain & (values != 0.0)])
        near = (is_plain[1:] != is_plain[:-1]) & (np.diff(labels[order][filled]) == 0) & (values[1:] * values[:-1] > 0)
        if plain.size >= 3 and np.abs(plain).max() < 1000 and near.any():
            steps = np.abs(np.diff(np.log10(np.where(values == 0.0, 1.0, np.abs(values)))))[near]
            found |= {group} if np.median(steps) < 1.0 else set()
    return found.pop() if len(found) == 1 else None
