"""Checks of output files, before a command starts its work.

An output is never one of the inputs, it replaces regular files only, and an existing file whose content does not match
its suffix is replaced only with `--force`.
"""

import re
import stat
from codecs import getincrementaldecoder
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.records.input_file import list_files

_FILE_SUFFIX = re.compile(r"\.[A-Za-z][A-Za-z0-9]{1,6}")
"""A new folder has no such suffix, which looks like that of a file."""

_HEAD_BYTES = 65_536


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
    """Check that a folder's name is not that of a file.

    Args:
        folder: path of the folder.
        option: option of the command line that names it.

    Raises:
        InputError: it is no folder, or a new one with the suffix of a file.
    """
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
    """Refuse an output that is one of the inputs, under any name.

    Raises:
        InputError: it is.
    """
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
