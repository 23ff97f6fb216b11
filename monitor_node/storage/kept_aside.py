"""Unusable files are kept under other names, and never overwritten.

A state learned over months may be wanted back with the settings it was learned with; a damaged file may be worth a
look.
"""

import contextlib
import re
from collections.abc import Callable, Iterable
from pathlib import Path

from reactorwatch.errors import InputError

DAMAGED, OTHER_SETTINGS = ".damaged", ".other-settings"

_NAME = re.compile(rf"(.+?)(?:{re.escape(DAMAGED)}|{re.escape(OTHER_SETTINGS)})(?:\.\d+)?")


def keep_aside(path: Path, ending: str) -> Path:
    """Rename a file to its name with the ending, and a number if that name is taken; returns the new path.

    Raises:
        OSError: the file cannot be renamed.
    """
    aside, number = path.with_name(path.name + ending), 1
    while True:
        try:
            aside.touch(exist_ok=False)  # takes the name, also where two processes keep files aside at once
        except FileExistsError:
            number += 1
            aside = path.with_name(f"{path.name}{ending}.{number}")
        else:
            try:
                return path.replace(aside)
            except OSError:
                aside.unlink()
                raise


def find_kept_aside(folder: Path) -> dict[str, list[Path]]:
    """Kept files of a folder by their original name, the newest first."""
    found: dict[str, list[tuple[int, Path]]] = {}
    for path in folder.iterdir() if folder.is_dir() else []:
        match = _NAME.fullmatch(path.name)
        if match is not None and path.is_file():
            with contextlib.suppress(FileNotFoundError):  # another monitor has just put it back
                found.setdefault(match[1], []).append((path.stat().st_mtime_ns, path))
    return {name: [path for _, path in sorted(dated, reverse=True)] for name, dated in found.items()}


def put_back(path: Path, asides: Iterable[Path], use: Callable[[bytes], None]) -> Path | None:
    """Use the first usable one of the kept files, and rename it back; returns the name it was kept under, or None.

    Args:
        path: original name, which no file has now.
        asides: kept files.
        use: called with the bytes of a file; raises InputError if they are unusable.

    Raises:
        OSError: a file cannot be read or renamed.
    """
    for aside in asides:
        try:
            use(aside.read_bytes())
        except InputError:
            continue
        aside.replace(path)
        return aside
    return None


def read_regular(path: Path) -> bytes | None:
    """Bytes of a regular file; None: there is none.

    Raises:
        InputError: the path is a device, a pipe or a folder, which can hold no state.
        OSError: the file cannot be read.
    """
    if not path.exists():
        return None
    if not path.is_file():
        raise InputError("is not a regular file; name one")
    return path.read_bytes()
