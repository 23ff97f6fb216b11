"""Write a record as a table: CSV, compressed CSV, workbook or Parquet, by the file's suffix; or a data frame."""

import csv
import gzip
import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from reactorwatch.errors import InputError
from reactorwatch.records.atomic import atomic_write
from reactorwatch.records.cells import quote_formula
from reactorwatch.records.record import LARGEST_VALUE, LONGEST_MIN, MINUTE_NS, Record
from reactorwatch.records.source_text import PARQUET_SUFFIXES, import_openpyxl

TIME, RUN, CLOCK = "time_min", "run", "time"
"""Columns beside the signals: minutes, the run of each row if there are several, and clock time if it is asked for."""

WRITTEN_SUFFIXES = (".csv", ".gz", ".xlsx", ".parquet")
MAX_SHEET_ROWS = 1_048_576


def write_table(path: Path, record: Record, *, clock: bool = False) -> None:
    """Write a record so that `read_table` returns exactly the same numbers; a workbook holds 16 digits.

    Args:
        path: the file; its suffix decides the form: .csv, .gz (compressed CSV), .xlsx or .parquet.
        record: the record.
        clock: add a column with the clock time of each row, ISO 8601 in UTC.

    Raises:
        InputError: the folder does not exist or cannot be written to, the record has no clock time to be added, a
            signal has the name of another column, a library is not installed, or a workbook cannot hold so many rows.
        ValueError: a time or a value that `read_table` refuses, such as an infinite one.
    """
    suffix = path.suffix.lower()
    if suffix == ".xlsx":
        _write_workbook(path, record, clock)
    elif suffix in PARQUET_SUFFIXES:
        _write_parquet(path, record, clock)
    else:
        _write_text(path, record, clock, compress=suffix == ".gz")


def _columns(record: Record, clock: bool) -> dict[str, list[Any]]:
    """Cells by header; None where nothing was measured."""
    if not (np.abs(record.time_min) <= LONGEST_MIN).all():
        raise ValueError(f"times must be within {LONGEST_MIN:.3g} min of their zero to be read again")
    own = [TIME, *([RUN] if record.runs is not None else []), *([CLOCK] if clock else [])]
    for name in own:
        if name in record.columns:
            raise InputError(
                f"{record.name}: signal {name!r} has the name of a column that is written beside the signals "
                f"({', '.join(own)}); give it another name, with column = {name!r} in the description of its process"
            )
    columns: dict[str, list[Any]] = {TIME: record.time_min.tolist()}
    for signal, values in record.raw_columns.items():
        if (np.abs(values) >= LARGEST_VALUE).any():
            raise ValueError(
                f"column {signal!r} must be below {LARGEST_VALUE:g} or NaN to be read again, "
                f"got {np.nanmax(np.abs(values)):g}"
            )
        columns[signal] = [None if math.isnan(value) else value for value in values.tolist()]
    if record.runs is not None:
        columns[RUN] = record.runs.tolist()
    if clock:
        columns[CLOCK] = _clock_texts(record)
    return columns


def _clock_texts(record: Record) -> list[str]:
    if not record.zero_ns:
        raise InputError(f"{record.name}: has no clock time that --clock could add, only minutes")
    times = record.zero_ns + np.round(record.time_min * MINUTE_NS / 1000).astype(np.int64) * 1000
    unit = next(unit for unit, size in (("s", 10**9), ("ms", 10**6), ("us", 10**3)) if not (times % size).any())
    return [f"{text}Z" for text in times.astype("datetime64[ns]").astype(f"datetime64[{unit}]").astype(str).tolist()]


def _write_text(path: Path, record: Record, clock: bool, *, compress: bool = False) -> None:
    columns = _columns(record, clock)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        packed = gzip.GzipFile("", "wb", fileobj=file, mtime=0) if compress else file
        with io.TextIOWrapper(packed, encoding="utf-8", newline="") as text:
            writer = csv.writer(text, lineterminator="\n")  # writes a float as its repr, which reads back exactly
            writer.writerow(map(quote_formula, columns))
            writer.writerows(zip(*columns.values(), strict=True))


def _write_workbook(path: Path, record: Record, clock: bool) -> None:
    if record.rows >= MAX_SHEET_ROWS:
        raise InputError(
            f"{path}: a sheet has at most {MAX_SHEET_ROWS} rows, got {record.rows}; write .parquet or .csv"
        )
    columns, openpyxl = _columns(record, clock), import_openpyxl(path)
    book = openpyxl.Workbook(write_only=True)
    sheet = book.create_sheet("record")
    sheet.append([_text_cell(openpyxl, sheet, path, name) for name in columns])
    for row in zip(*columns.values(), strict=True):
        sheet.append(row)
    with atomic_write(path) as temporary:
        book.save(temporary)


def _text_cell(openpyxl: Any, sheet: Any, path: Path, text: str) -> Any:
    """Cell of a text, which the library would take for a formula if it starts with =, and a spreadsheet on editing."""
    try:
        cell = openpyxl.cell.WriteOnlyCell(sheet, text)
    except openpyxl.utils.exceptions.IllegalCharacterError as error:
        raise InputError(
            f"{path}: a workbook cannot hold the control characters in the name {text!r}; write .csv or .parquet"
        ) from error
    cell.data_type = "s"
    cell.quotePrefix = quote_formula(text) != text
    return cell


def _write_parquet(path: Path, record: Record, clock: bool) -> None:
    import pyarrow as pa
    import pyarrow.parquet

    table = pa.table(_columns(record, clock))
    with atomic_write(path) as temporary:
        pyarrow.parquet.write_table(table, temporary)


def write_frame(frame: Any, path: Path) -> Path:
    """Write a data frame (pandas, polars, Arrow) as a Parquet file; returns its path.

    Raises:
        InputError: the frame has columns that are no plain values.
    """
    import pyarrow as pa
    import pyarrow.parquet

    try:
        pyarrow.parquet.write_table(pa.table(frame), path)
    except (pa.ArrowException, TypeError) as error:
        reason = str(error).partition("\n")[0]
        raise InputError(f"data frame: expected columns of plain values: {reason}") from error
    return path
