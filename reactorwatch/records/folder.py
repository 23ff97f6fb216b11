"""Output folders."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.records.atomic import atomic_write, wrap_write_errors
from reactorwatch.records.output import check_folder_name


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
