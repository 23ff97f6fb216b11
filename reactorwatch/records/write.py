"""Write records as tables (CSV, gzip, workbook, Parquet), and files and folders atomically, after checks."""

import csv
import glob
import gzip
import io
import math
import os
import re
import shutil
import stat
from codecs import getincrementaldecoder
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reactorwatch.errors import InputError
from reactorwatch.records.decode import PARQUET_SUFFIXES, list_files, quote_formula
from reactorwatch.records.file_format import CLOCK_COLUMN, RUN_COLUMN, TIME_COLUMN

if TYPE_CHECKING:
    from reactorwatch.records.record import Record  # it imports NumPy, and help is to be fast

_FILE_SUFFIX = re.compile(r"\.[A-Za-z][A-Za-z0-9]{1,6}")
"""A new folder has no such suffix, which looks like that of a file."""

_HEAD_BYTES = 65_536  # more than any header has


def check_output_file(path: Path, sources: Iterable[Path | None] = (), *, force: bool = False) -> Path:
    """Check that a file may be written.

    Args:
        path: the file.
        sources: files and folders that the command reads; a folder stands for the recordings in it, None for nothing.
        force: replace a file although its content does not match its suffix.

    Returns:
        The path.

    Raises:
        InputError: its folder does not exist, it is no regular file, it is one of the sources, or its content does not
            match its suffix.
    """
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist; create it first")
    if not is_replaceable(path):
        return path
    refuse_source(path, sources)
    if not force and not _matches_suffix(path):
        raise InputError(
            f"{path}: is there already and is not a {path.suffix} file by its content; "
            "name another file, or replace it with --force"
        )
    return path


def check_folder_name(folder: Path, option: str) -> None:
    """Check that a folder's name is not that of a file."""
    if folder.exists():
        if not folder.is_dir():
            kind = "a file" if folder.is_file() else "no folder"
            raise InputError(f"{option} {folder}: is {kind}, the name of a folder was expected")
    elif _FILE_SUFFIX.fullmatch(folder.suffix):
        raise InputError(
            f"{option} {folder}: no {folder.suffix} file is written, the name of a folder was expected; "
            f"name it {folder.stem}"
        )


def check_output_folder(
    folder: Path,
    names: Iterable[str] = (),
    sources: Iterable[Path | None] = (),
    *,
    option: str = "--out",
    force: bool = False,
) -> Path:
    """Check that files may be written into a folder, which need not exist.

    Args:
        folder: the folder.
        names: names of the files that are written or deleted in it.
        sources: see `check_output_file`.
        option: option of the command line that names the folder.
        force: see `check_output_file`.

    Returns:
        The folder.

    Raises:
        InputError: it is no folder, has the name of a file, or as `check_output_file` for one of the files.
    """
    check_folder_name(folder, option)
    if not folder.exists():
        return folder
    read = list(sources)
    for name in names:
        if (folder / name).parent.is_dir():
            check_output_file(folder / name, read, force=force)
    return folder


def is_replaceable(path: Path) -> bool:
    """True if a regular file is at a path, False if nothing is.

    Raises:
        InputError: something else is there, such as a folder, a device, a pipe or a socket, perhaps through a link; or
            the system refuses to tell.
    """
    try:
        mode = file_mode(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error
    if stat.S_ISDIR(mode):
        raise InputError(f"cannot write {path}: it is a folder, a file name was expected")
    if not stat.S_ISREG(mode):
        raise InputError(f"cannot write {path}: it is no regular file, and only those are replaced; name another file")
    return True


def file_mode(path: Path) -> int:
    """Type and permissions of a file, or of a link's target."""
    return path.stat().st_mode


def refuse_source(path: Path, sources: Iterable[Path | None]) -> None:
    """Refuse an output that is one of the inputs, under any name."""
    if not path.exists():
        return
    for source in sources:
        if source is None:
            continue
        for file in list_files(source, ".mcap") if source.is_dir() else [source]:
            if file.exists() and path.samefile(file):
                raise InputError(f"{path}: is one of the files that are read ({file}); name another file")


def _matches_suffix(path: Path) -> bool:
    """True if the start of an existing file matches its suffix; an empty file matches any."""
    fits = _KINDS.get(path.suffix.lower())
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error
    return not head or (fits is not None and fits(head))


def _text(head: bytes) -> str | None:
    """Decode the start of a file; None if it is no text."""
    decoder = getincrementaldecoder("utf-8-sig")()
    try:
        text = decoder.decode(head, final=len(head) < _HEAD_BYTES)  # else the last character may be incomplete
    except UnicodeDecodeError:
        return None
    return None if "\0" in text else text


def _is_table(head: bytes) -> bool:
    first_line = (_text(head) or "").lstrip().partition("\n")[0]
    return any(separator in first_line for separator in ",;\t")


def _is_text_from(*starts: str) -> Callable[[bytes], bool]:
    return lambda head: (_text(head) or "").lstrip().startswith(starts)


def _starts_with(magic: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(magic)


_KINDS: Mapping[str, Callable[[bytes], bool]] = {
    ".csv": _is_table,
    ".gz": _starts_with(b"\x1f\x8b"),
    ".html": _is_text_from("<"),
    ".json": _is_text_from("{", "["),
    ".mcap": _starts_with(b"\x89MCAP"),
    ".md": lambda head: _text(head) is not None,
    ".parquet": _starts_with(b"PAR1"),
    ".png": _starts_with(b"\x89PNG"),
    ".rrd": _starts_with(b"RRF"),
    ".xlsx": _starts_with(b"PK\x03\x04"),
}
"""Check of the start of a file, by suffix. Files with other suffixes are never overwritten."""


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary name to write to; when the block ends, that file replaces `path`.

    When the block raises, `path` is unchanged and the temporary file is removed. The target of a link is replaced, not
    the link.

    Raises:
        InputError: the folder does not exist or cannot be written to, or `path` is no regular file.
    """
    is_replaceable(path)
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        if not target.parent.is_dir():
            raise InputError(f"cannot write {path}: the folder {target.parent} does not exist")
        temporary.touch()
        temporary.unlink()  # some writers refuse an existing file
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error
    try:
        with wrap_write_errors(path, temporary):
            yield temporary
            temporary.replace(target)
    except BaseException:
        for rest in temporary.parent.glob(f"{glob.escape(temporary.name)}*"):  # a writer may add a suffix
            rest.unlink()
        raise


def write_durably(path: Path, data: bytes, check: Callable[[], None] = lambda: None) -> None:
    """Replace a file atomically; it is on the disk when this returns.

    Args:
        path: the file.
        data: its new bytes.
        check: called just before the file is replaced; if it raises, `path` is unchanged.

    Raises:
        InputError: see `atomic_write`.
    """
    with atomic_write(path) as temporary:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        check()


@contextmanager
def wrap_write_errors(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Turn the system's errors about a file that is written into an `InputError` of one line.

    Args:
        path: the file, as named in messages.
        temporary: name under which it is written; None: `path`.

    Raises:
        InputError: the file cannot be written; its cause is the system's error.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None and Path(error.filename).name != (temporary or path).name:
            raise  # about another file
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error
    except InputError as error:
        cause = error.__cause__
        if temporary is None or temporary.name not in str(error) or not isinstance(cause, OSError):
            raise
        raise InputError(f"cannot write {path}: {cause.strerror or cause}") from cause


def make_folder(folder: Path, option: str = "", *, may_exist: bool = True) -> Path:
    """Make a folder, and those that it is in.

    Args:
        folder: path of the folder.
        option: option of the command line that names it, such as `--out`, for messages; empty: none.
        may_exist: accept an existing folder.

    Returns:
        The folder.

    Raises:
        InputError: the folder cannot be made, or has the name of a file.
    """
    if option:
        check_folder_name(folder, option)
    try:
        folder.mkdir(parents=True, exist_ok=may_exist)
    except OSError as error:
        named = f"{option} {folder}" if option else folder
        raise InputError(f"{named}: the folder cannot be made: {error.strerror}") from error
    return folder


@contextmanager
def fill_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder; when the block ends, its files are moved to `folder`, which `--out` names.

    `folder` is made if it does not exist. When the block raises, it is unchanged and the temporary folder is removed.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    beside = next(path for path in (folder, *folder.absolute().parents) if path.is_dir())
    temporary = beside / f".{folder.name}.{os.getpid()}.tmp"
    try:
        temporary.mkdir()
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written to: {error.strerror}") from error
    try:
        yield temporary
        make_folder(folder, "--out")
        for file in sorted(path for path in temporary.rglob("*") if path.is_file()):
            target = folder / file.relative_to(temporary)
            make_folder(target.parent)
            with atomic_write(target) as temporary_file, wrap_write_errors(target):
                file.replace(temporary_file)
    except InputError as error:
        raise InputError(str(error).replace(str(temporary), str(folder))) from error.__cause__
    finally:
        shutil.rmtree(temporary)


WRITTEN_SUFFIXES = (".csv", ".gz", ".xlsx", ".parquet")


def write_table(path: Path, record: "Record", *, clock: bool = False) -> None:
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


def _columns(record: "Record", clock: bool) -> dict[str, list[Any]]:
    """Cells by header; None where nothing was measured."""
    import numpy as np

    from reactorwatch.records.record import LARGEST_VALUE, LONGEST_MIN, MINUTE_NS

    if not (np.abs(record.time_min) <= LONGEST_MIN).all():
        raise ValueError(f"times must be within {LONGEST_MIN:.3g} min of their zero to be read again")
    own = [TIME_COLUMN, *([RUN_COLUMN] if record.runs is not None else []), *([CLOCK_COLUMN] if clock else [])]
    for name in own:
        if name in record.columns:
            raise InputError(
                f"{record.name}: signal {name!r} has the name of a column that is written beside the signals "
                f"({', '.join(own)}); give it another name, with column = {name!r} in the description of its process"
            )
    columns: dict[str, list[Any]] = {TIME_COLUMN: record.time_min.tolist()}
    for signal, values in record.raw_columns.items():
        if (np.abs(values) >= LARGEST_VALUE).any():
            raise ValueError(
                f"column {signal!r} must be below {LARGEST_VALUE:g} or NaN to be read again, "
                f"got {np.nanmax(np.abs(values)):g}"
            )
        columns[signal] = [None if math.isnan(value) else value for value in values.tolist()]
    if record.runs is not None:
        columns[RUN_COLUMN] = record.runs.tolist()
    if clock:
        if not record.zero_ns:
            raise InputError(f"{record.name}: has no clock time that --clock could add, only minutes")
        times = record.zero_ns + np.round(record.time_min * MINUTE_NS / 1000).astype(np.int64) * 1000
        unit = next(unit for unit, size in (("s", 10**9), ("ms", 10**6), ("us", 10**3)) if not (times % size).any())
        texts = times.astype("datetime64[ns]").astype(f"datetime64[{unit}]").astype(str).tolist()
        columns[CLOCK_COLUMN] = [f"{text}Z" for text in texts]
    return columns


def _write_text(path: Path, record: "Record", clock: bool, *, compress: bool = False) -> None:
    columns = _columns(record, clock)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        packed = gzip.GzipFile("", "wb", fileobj=file, mtime=0) if compress else file
        with io.TextIOWrapper(packed, encoding="utf-8", newline="") as text:
            writer = csv.writer(text, lineterminator="\n")  # writes a float as its repr, which reads back exactly
            writer.writerow(map(quote_formula, columns))
            writer.writerows(zip(*columns.values(), strict=True))


def _write_workbook(path: Path, record: "Record", clock: bool) -> None:
    if record.rows >= 1_048_576:  # of Excel since 2007
        raise InputError(f"{path}: a sheet has at most 1048576 rows, got {record.rows}; write .parquet or .csv")
    try:
        import openpyxl
    except ImportError as error:
        raise InputError(
            f"{path}: a workbook is written with openpyxl: install reactorwatch[excel], or write .csv"
        ) from error
    columns = _columns(record, clock)
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


def _write_parquet(path: Path, record: "Record", clock: bool) -> None:
    import pyarrow as pa
    import pyarrow.parquet

    table = pa.table(_columns(record, clock))
    with atomic_write(path) as temporary:
        pyarrow.parquet.write_table(table, temporary)


def write_frame(frame: Any, path: Path) -> Path:
    """Write a data frame (pandas, polars, Arrow) as a Parquet file; returns its path."""
    import pyarrow as pa
    import pyarrow.parquet

    try:
        pyarrow.parquet.write_table(pa.table(frame), path)
    except (pa.ArrowException, TypeError) as error:
        reason = str(error).partition("\n")[0]
        raise InputError(f"data frame: expected columns of plain values: {reason}") from error
    return path
