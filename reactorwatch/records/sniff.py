"""Layout of a text table, guessed from its first lines: separator, header, orientation."""

import csv
import io
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from reactorwatch.errors import InputError
from reactorwatch.records.cells import EMPTY, MISSING, NUMBER, TEXT, TIME, kind_of, to_numbers
from reactorwatch.records.file_format import FileFormat
from reactorwatch.records.header import HeaderSearch
from reactorwatch.records.layout import COMMENT, Layout, split_line

HEAD_BYTES = 65_536
HEAD_LINES = 200
"""Lines from which the layout is guessed."""

MIN_LINES = 12
"""Fewer whole lines in the head are extended: lines of a transposed file are long."""

MIN_TRANSPOSED = 10
"""Fewest columns of a file without names that may be taken as rows."""

MAX_CELL_LINES = 4
"""Most lines of a quoted cell in the head."""

_SEPARATORS = ";\t,| "
_BLANKS = re.compile(rb"[ \t]+")


def sniff(path: Path, text: bytes, stated: FileFormat) -> Layout:
    """Guess the layout of a table.

    Args:
        path: the file, for messages.
        text: text of the file, UTF-8.
        stated: what need not be guessed.

    Raises:
        InputError: the decimal sign is ambiguous, or the rows have more cells than the header.
    """
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
    while text.count(b"\n", 0, size) < MIN_LINES and size < len(text):
        size *= 4
    lines = text[:size].decode(errors="ignore").split("\n")
    lines = lines[:HEAD_LINES] if size >= len(text) else lines[:-1][:HEAD_LINES]
    found: list[tuple[int, str]] = []
    row = 0
    while row < len(lines):
        ends = range(row + 1, min(row + 1 + MAX_CELL_LINES, len(lines)) + 1)
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
    if width < MIN_TRANSPOSED or layout.text.count(b"\n") >= width:
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
