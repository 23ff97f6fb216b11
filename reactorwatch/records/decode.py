"""Any file of measured data as the bytes of a text table: decompressed, decoded, workbooks and Parquet written out."""

import csv
import functools
import gzip
import io
import itertools
import re
import stat
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import date, datetime, time, timedelta
from pathlib import Path
from typing import Any

from reactorwatch.errors import InputError, hint_at_closest
from reactorwatch.limits import limits

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

LARGEST_TEXT = 2_000_000_000
"""Most bytes of a compressed text or workbook: a small file cannot exhaust memory."""

_COLUMN, _ROW = re.compile(rb'\br="([A-Z]+)\d'), re.compile(rb'\br="[A-Z]*(\d+)"')
_CELL = re.compile(rb"<c[\s/>]")
"""References of cells and rows in a sheet, and cells: `<cfRule` and `<col` are none."""

_MAGIC = {b"\x1f\x8b": "gz", b"PK\x03\x04": "xlsx", b"\xd0\xcf\x11\xe0": "xls", b"PAR1": "parquet", b"\x89MCAP": "mcap"}
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


def read_text(path: Path, sheet: str | None = None) -> tuple[bytes, list[str]]:
    r"""Read a file as UTF-8 text with lines that end in \n."""
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
        data, note = _workbook(path, data, sheet)
        return data, [*notes, note]
    if kind == "xls":
        raise InputError(f"{path}: expected a workbook (.xlsx), got an older or an encrypted one; save it as .xlsx")
    if kind == "parquet":
        return _parquet(path, data), [*notes, "Parquet"]
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS.items() if data.startswith(mark)), None)
    encoding = encoding or _guess_encoding(data[:4096])
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


def check_workbook(path: Path, sheet: str | None) -> None:
    """Check that a file is a workbook if a sheet of it is asked for.

    Args:
        path: the file, or a folder of recordings.
        sheet: what `--sheet` names; None: nothing.

    Raises:
        InputError: it is none, or cannot be read.
    """
    if sheet is None:
        return
    head = b""
    if not path.is_dir():
        with wrap_read_errors(path), path.open("rb") as file:
            head = file.read(4)
        if _kind(head) == "gz":
            with suppress(OSError, EOFError, zlib.error), gzip.open(path) as packed:
                head = packed.read(4)
    if _kind(head) not in ("xlsx", "xls"):
        raise InputError(f"{path}: --sheet {sheet!r} is of a workbook (.xlsx), and this is none; leave it out")


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


def _workbook(path: Path, data: bytes, asked: str | None) -> tuple[bytes, str]:
    """Write a sheet as text: the one that is asked for, or the first that holds a table; and a note on it."""
    import python_calamine

    try:
        book = python_calamine.load_workbook(_unpack_workbook(path, data))
        kinds = python_calamine.SheetTypeEnum
        names = [sheet.name for sheet in book.sheets_metadata if sheet.typ == kinds.WorkSheet]
        if asked is not None:
            number = int(asked) if asked.isdecimal() else 0
            if asked not in names and not 1 <= number <= len(names):
                found = ", ".join(map(repr, names))
                raise InputError(
                    f"{path}: expected a sheet {asked!r} (--sheet), got {found}{hint_at_closest(asked, names)}"
                )
            names = [asked if asked in names else names[number - 1]]
        sheets = {name: book.get_sheet_by_name(name).to_python(skip_empty_area=False) for name in names}
    except (python_calamine.CalamineError, zipfile.BadZipFile, zlib.error, OSError, NotImplementedError) as error:
        raise InputError(f"{path}: expected a workbook (.xlsx), got a damaged or another file: {error}") from error
    filled = [name for name, rows in sheets.items() if any(cell != "" for row in rows for cell in row)]
    if not filled:
        raise InputError(f"{path}: expected a sheet with rows, got an empty {'workbook' if asked is None else 'sheet'}")
    tables = [name for name in filled if _holds_table(sheets[name])]
    first, *others = tables or filled
    rows = [[_cell(value) for value in row] for row in sheets[first]]
    rows[0] = [quote_formula(cell) for cell in rows[0]]  # as in a text that is written here
    lines = io.StringIO()
    csv.writer(lines, lineterminator="\n").writerows(rows)
    also = f" (--sheet reads {', '.join(f'`{name}`' for name in others)})" if tables and others else ""
    return lines.getvalue().encode(), f"sheet `{first}`{also}"


def _unpack_workbook(path: Path, data: bytes) -> io.BytesIO:
    """Copy of a workbook without compression, whose sheets fit into memory: the reader of sheets has no limits."""
    plain, size = io.BytesIO(), 0
    with zipfile.ZipFile(io.BytesIO(data)) as packed, zipfile.ZipFile(plain, "w") as unpacked:
        if "xl/workbook.xml" not in packed.namelist():
            raise InputError(f"{path}: expected a workbook (.xlsx), got another kind of file; save it as .xlsx")
        for info in packed.infolist():
            with packed.open(info) as part:
                content = part.read(LARGEST_TEXT - size + 1)
            size += len(content)
            cells = 0
            if info.filename.startswith("xl/worksheets/"):
                width = max(map(_column_number, set(_COLUMN.findall(content))), default=0)
                width = max(width, *(len(_CELL.findall(row)) for row in content.split(b"<row")))
                cells = width * max(map(int, _ROW.findall(content)), default=0)
            if max(size, cells * 32) > LARGEST_TEXT:  # bytes of a cell in memory, empty or not
                raise InputError(
                    f"{path}: expected sheets that unpack to at most {LARGEST_TEXT / 1e9:g} GB, got more in "
                    f"{info.filename}; delete what is far from the table, split it, or save it as CSV"
                )
            unpacked.writestr(info.filename, content)
    plain.seek(0)
    return plain


def _column_number(letters: bytes) -> int:
    """Number of a column such as B or AA, from 1."""
    return functools.reduce(lambda number, letter: 26 * number + letter - 64, letters, 0)


def _holds_table(rows: list[list[Any]]) -> bool:
    """True for a sheet with two rows or more of several cells, of which one is a number or a time."""
    filled = ([cell for cell in row if cell != ""] for row in rows)
    values = (len(row) > 1 and any(not isinstance(cell, str) or cell[-1].isdigit() for cell in row) for row in filled)
    return sum(itertools.islice(filter(None, values), 2)) == 2


def _cell(value: object) -> str:
    """Text of a cell; a spreadsheet has no whole numbers, and midnight is a date in it."""
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() and abs(value) < 1e16 else repr(value)  # then 1e+16
    if isinstance(value, timedelta):
        return repr(value.total_seconds())
    if type(value) is date:
        value = datetime.combine(value, time())
    return value.isoformat() if isinstance(value, datetime | time) else str(value)


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
