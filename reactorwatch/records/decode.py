"""Any file of measured data as the bytes of a text table: decompressed, decoded, workbooks and Parquet written out."""

import csv
import gzip
import io
import re
import stat
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

from reactorwatch.errors import InputError
from reactorwatch.limits import limits


@contextmanager
def wrap_read_errors(path: Path) -> Iterator[None]:
    """Turn the system's errors about a file that is read into an `InputError` of one line.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def read_regular(path: Path, *, bounded: bool = True) -> bytes:
    """Read a regular file; a pipe may never begin, and a device may never end.

    Args:
        path: the file.
        bounded: check its size before it is read, see `Limits.file_bytes`.

    Raises:
        InputError: something else is at the path, or it is too large; the text does not name it.
        OSError: the file cannot be read.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise InputError("is not a regular file; name one")
    if bounded:
        limits().check("file_bytes", "size in bytes", status.st_size)
    return path.read_bytes()


def list_files(folder: Path, suffix: str) -> list[Path]:
    """List the files in a folder with a suffix, in any case, in the order of their names."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() == suffix and path.is_file())


TEXT_SUFFIXES = (".csv", ".tsv", ".tab", ".txt", ".dat", ".asc", ".prn", ".lvm", ".gz")
WORKBOOK_SUFFIXES = (".xlsx", ".xlsm")
PARQUET_SUFFIXES = (".parquet", ".pq")
TABLE_SUFFIXES = (*TEXT_SUFFIXES, *WORKBOOK_SUFFIXES, *PARQUET_SUFFIXES)
"""Suffixes of files that hold a record as a table."""

_WIDE = {"utf-16", "utf-16-le", "utf-16-be", "utf-32"}
"""Encodings of several bytes a letter."""

HEAD_BYTES = 4096
"""Bytes by which the encoding is guessed."""

LARGEST_TEXT = 2_000_000_000
"""Most bytes of a compressed text: a small file cannot exhaust memory."""

_MAGIC = {b"\x1f\x8b": "gz", b"PK\x03\x04": "xlsx", b"PAR1": "parquet", b"\x89MCAP": "mcap"}
_BYTE_ORDER_MARKS = {
    b"\xef\xbb\xbf": "utf-8-sig",
    b"\xff\xfe\0\0": "utf-32",
    b"\0\0\xfe\xff": "utf-32",
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
}


def is_table(path: Path) -> bool:
    """True for a file with the suffix of a table."""
    return path.suffix.lower() in TABLE_SUFFIXES


def read_text(path: Path) -> tuple[bytes, list[str]]:
    r"""Read a file as UTF-8 text with lines that end in \n.

    Returns:
        The text, and what is unusual about the file.

    Raises:
        InputError: the file cannot be read, is empty or holds no text.
    """
    with wrap_read_errors(path):
        try:
            data = path.read_bytes()
        except IsADirectoryError as error:
            raise InputError(f"{path}: expected a CSV file, got a folder") from error
    notes = []
    kind = _kind(data)
    if kind == "mcap":
        raise InputError(f"{path}: expected a CSV file, got an MCAP recording; give it the ending .mcap")
    if kind == "gz":
        try:
            with gzip.GzipFile(fileobj=io.BytesIO(data)) as packed:
                data = packed.read(LARGEST_TEXT + 1)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(f"{path}: expected a complete gzip file, got {error}") from error
        if len(data) > LARGEST_TEXT:
            raise InputError(
                f"{path}: expected at most {LARGEST_TEXT / 1e9:g} GB of text, got more; unpack or split it"
            )
        notes.append("gzip")
        kind = _kind(data)
    if kind == "xlsx":
        data, sheet = _workbook(path, data)
        return data, [*notes, f"sheet `{sheet}`"]
    if kind == "parquet":
        return _parquet(path, data), [*notes, "Parquet"]
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS.items() if data.startswith(mark)), None)
    encoding = encoding or _guess_encoding(data[:HEAD_BYTES])
    if encoding not in _WIDE and b"\0" in data:
        raise InputError(f"{path}: expected a CSV file, got binary data; export the table as .csv")
    if encoding != "utf-8" or not data.isascii():
        data, read_as = _decode(path, data, encoding)
        notes += [read_as] if read_as else []
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if not data or data.isspace():
        raise InputError(f"{path}: expected a header and rows, got an empty file")
    return data, notes


def _kind(data: bytes) -> str:
    return next((kind for magic, kind in _MAGIC.items() if data.startswith(magic)), "text")


def _guess_encoding(head: bytes) -> str:
    """Encoding of a text without a byte order mark: in UTF-16 nearly every other byte of a table is 0."""
    zeros = [head[start::2].count(0) for start in (0, 1)]
    if max(zeros) > len(head) // 4 and min(zeros) < len(head) // 50:
        return "utf-16-be" if zeros[0] > zeros[1] else "utf-16-le"
    return "utf-8"


def _decode(path: Path, data: bytes, encoding: str) -> tuple[bytes, str]:
    """Text as UTF-8, and the encoding to be named; bytes that are no UTF-8 are taken as Windows-1252."""
    try:
        return data.decode(encoding).encode(), encoding[:6].upper() if encoding in _WIDE else ""
    except UnicodeDecodeError as error:
        if encoding in _WIDE:
            raise InputError(
                f"{path}: expected {encoding[:6].upper()} text, as its first bytes say: {error.reason}"
            ) from error
    return data.decode("cp1252", errors="replace").encode(), "Windows-1252"


def import_openpyxl(path: Path) -> Any:
    """Import the library for workbooks.

    Raises:
        InputError: it is not installed.
    """
    try:
        import openpyxl
    except ImportError as error:
        raise InputError(f"{path}: workbooks need openpyxl: install reactorwatch[excel], or save it as CSV") from error
    return openpyxl


def _workbook(path: Path, data: bytes) -> tuple[bytes, str]:
    """Write the first sheet that has rows as text."""
    openpyxl = import_openpyxl(path)
    try:
        book = openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=True)
        for sheet in book.worksheets:
            rows = [[_cell(value) for value in row] for row in sheet.iter_rows(values_only=True)]
            width = max(map(len, rows), default=0)  # empty cells at the end of a row may be absent
            lines = io.StringIO()
            writer = csv.writer(lines, lineterminator="\n")
            rows[:1] = [[quote_formula(cell) for cell in row] for row in rows[:1]]  # as in a text that is written here
            writer.writerows([*row, *[""] * (width - len(row))] for row in rows)
            if lines.getvalue().strip('", \n'):
                return lines.getvalue().encode(), str(sheet.title)
    except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: expected a workbook (.xlsx), got a damaged or another file: {error}") from error
    raise InputError(f"{path}: expected a sheet with rows, got an empty workbook")


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, timedelta):
        return repr(value.total_seconds())
    if hasattr(value, "isoformat"):
        return str(value.isoformat())
    return repr(value) if isinstance(value, float) else str(value)


def _parquet(path: Path, data: bytes) -> bytes:
    """Write a Parquet file as text."""
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    try:
        table = pyarrow.parquet.read_table(pa.BufferReader(data))
        table = table.rename_columns([quote_formula(name) for name in table.column_names])
        text = pa.BufferOutputStream()
        pyarrow.csv.write_csv(table, text)
    except pa.ArrowException as error:
        reason = str(error).partition("\n")[0]
        raise InputError(f"{path}: expected a Parquet file with columns of plain values: {reason}") from error
    return bytes(text.getvalue())


_FORMULA = re.compile(r"(^|[;\t\r\n])('*)(?=[=+\-@\t\r\uff1d\uff0b\uff0d\uff20])")
"""Start of what a spreadsheet takes for a formula, in a cell or behind a sign that may separate cells elsewhere."""


def quote_formula(text: str) -> str:
    """Text that a spreadsheet does not take for a formula: a quote before what would be one.

    >>> quote_formula("=1+2"), quote_formula("T-1"), quote_formula("'=1+2")
    ("'=1+2", 'T-1', "''=1+2")
    """
    return _FORMULA.sub(r"\1'\2", text)


def unquote_formula(text: str) -> str:
    """Text before `quote_formula`; another text is unchanged, unless it has such a quote.

    >>> unquote_formula("'=1+2"), unquote_formula("'a'")
    ('=1+2', "'a'")
    """
    return _FORMULA.sub(lambda match: match[1] + match[2][1:], text)
