"""The guard of every output: which file may be written, and what must not be lost by it.

Every command with an `-o` asks here before it starts its work. An output is never one of the files that are read, it
takes the place of regular files only, and a file that is there and is not of the kind that its suffix says is
replaced only with `--force`.
"""

import re
import stat
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.records.reading import files_of

_FILE_SUFFIX = re.compile(r"\.[A-Za-z][A-Za-z0-9]{1,6}")
"""A new folder has no such suffix: its name would be taken for that of a file of that kind."""

_HEAD_BYTES = 65_536
_PARTS = 4
"""Bytes of a UTF-8 character at most; the last one of a head may be cut off."""


def checked_output(path: Path, sources: Iterable[Path | None] = (), *, force: bool = False) -> Path:
    """Check that a file may be written.

    Args:
        path: the file.
        sources: files and folders that the command reads; a folder stands for the recordings in it, None for nothing.
        force: replace a file that is there although it is of another kind than its suffix says.

    Returns:
        The path.

    Raises:
        InputError: its folder does not exist, it is not a regular file, it is one of the sources, or it is a file of
            another kind.
    """
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist; create it first")
    if not is_replaceable(path):
        return path
    refuse_source(path, sources)
    if not force and not _is_of_its_kind(path):
        raise InputError(
            f"{path}: is there already and is not a {path.suffix} file by its content; "
            "name another file, or replace it with --force"
        )
    return path


def check_folder_name(folder: Path, option: str) -> None:
    """Check that a name is not that of a file.

    Args:
        folder: its path.
        option: of the command line that names it.

    Raises:
        InputError: it is no folder, or does not exist and has the suffix of a file.
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


def checked_folder(
    folder: Path,
    names: Iterable[str] = (),
    sources: Iterable[Path | None] = (),
    *,
    option: str = "--out",
    force: bool = False,
) -> Path:
    """Check that files may be written into a folder, which may be there or not.

    Args:
        folder: the folder.
        names: of the files that are written or deleted in it.
        sources: as for `checked_output`.
        option: of the command line that names the folder.
        force: as for `checked_output`.

    Returns:
        The folder.

    Raises:
        InputError: it is no folder, its name is that of a file, or as `checked_output` for one of the files.
    """
    check_folder_name(folder, option)
    if not folder.exists():
        return folder
    read = list(sources)
    for name in names:
        if (folder / name).parent.is_dir():
            checked_output(folder / name, read, force=force)
    return folder


def is_replaceable(path: Path) -> bool:
    """Return whether there is a regular file at a path; False if there is nothing.

    Raises:
        InputError: there is something else, such as a folder, a device, a pipe or a socket, be it through a link; or
            the system does not say.
    """
    try:
        mode = mode_of(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error
    if stat.S_ISDIR(mode):
        raise InputError(f"cannot write {path}: it is a folder, a file name was expected")
    if not stat.S_ISREG(mode):
        raise InputError(f"cannot write {path}: it is no regular file, and only those are replaced; name another file")
    return True


def mode_of(path: Path) -> int:
    """The type and permissions of a file, that a link leads to."""
    return path.stat().st_mode


def refuse_source(path: Path, sources: Iterable[Path | None]) -> None:
    """Refuse an output that is one of the files that are read, by the same name, through links, or by another name.

    Raises:
        InputError: it is.
    """
    if not path.exists():
        return
    for source in sources:
        if source is None:
            continue
        for file in files_of(source, ".mcap") if source.is_dir() else [source]:
            if file.exists() and path.samefile(file):
                raise InputError(f"{path}: is one of the files that are read ({file}); name another file")


def _is_of_its_kind(path: Path) -> bool:
    """Return whether an existing file begins as files of its suffix do; an empty file is of any kind."""
    fits = _KINDS.get(path.suffix.lower())
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error
    return not head or (fits is not None and fits(head))


def _text(head: bytes) -> str | None:
    """The text that a file begins with; None if it is no text."""
    for cut in range(_PARTS if len(head) == _HEAD_BYTES else 1):
        try:
            text = head[: len(head) - cut].decode("utf-8-sig")
        except UnicodeDecodeError:
            continue
        return None if "\0" in text else text
    return None


def _is_table(head: bytes) -> bool:
    text = (_text(head) or "").lstrip()
    return any(separator in text.partition("\n")[0] for separator in ",;\t")


def _is_json(head: bytes) -> bool:
    return (_text(head) or "").lstrip()[:1] in ("{", "[")


def _is_page(head: bytes) -> bool:
    return (_text(head) or "").lstrip()[:1] == "<"


def _is_text(head: bytes) -> bool:
    return _text(head) is not None


def _starts_with(magic: bytes) -> Callable[[bytes], bool]:
    return lambda head: head.startswith(magic)


_KINDS: Mapping[str, Callable[[bytes], bool]] = {
    ".csv": _is_table,
    ".html": _is_page,
    ".json": _is_json,
    ".mcap": _starts_with(b"\x89MCAP"),
    ".md": _is_text,
    ".png": _starts_with(b"\x89PNG"),
    ".rrd": _starts_with(b"RRF"),
}
"""By suffix: whether the beginning of a file is that of its kind. A suffix that is not here is never overwritten."""
