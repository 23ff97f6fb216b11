"""Columns of a text table, parsed by pyarrow."""

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.records.cells import NUMBER, find_sentinels, kind_of, to_numbers
from reactorwatch.records.layout import COMMENT, Layout, blank_repeats, describe_separator, is_remark

BLOCK_BYTES = 1 << 22
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
    """Columns of a table, by number from 0.

    Args:
        layout: the table and its layout.
        numbers: columns to be parsed as numbers.
        texts: columns to be kept as text.

    Raises:
        InputError: there are no rows, or one has another number of cells than the header.
    """

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
        """Some of the rows.

        Args:
            rows: indices of the rows, shape (rows of the part,).
        """
        part = copy(self)
        part._table, part._known, part._chosen = self._table.take(rows), {}, rows
        return part

    def numbers(self, column: int, rule: str = "expected a finite number or nothing") -> NDArray[np.float64]:
        """Numbers in a column, shape (rows,); NaN: not measured.

        Args:
            column: number of the column.
            rule: the rule to be named if a cell is no number.

        Raises:
            InputError: a cell is no number.
        """
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
        """Refuse a cell.

        Args:
            row: index of the row.
            column: number of the column.
            rule: the rule that the cell breaks.
            cure: what to do about it; `{}` stands for the cell.

        Raises:
            InputError: always; it names file, row, column, rule, cell and cure.
        """
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
