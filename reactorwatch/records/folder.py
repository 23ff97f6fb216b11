"""A folder that is to be written into."""

import re
from pathlib import Path

from reactorwatch.errors import InputError

FILE_ENDING = re.compile(r"\.[A-Za-z][A-Za-z0-9]{1,6}")
"""What the name of a folder does not end in: it would be taken for a file of that kind."""


def make_folder(folder: Path, option: str = "", *, may_exist: bool = True) -> Path:
    """Make a folder, and those that it is in.

    Args:
        folder: its path.
        option: of the command line that names it, such as `--out`, to be told with it; empty: none does.
        may_exist: whether it may be there already.

    Returns:
        The folder.

    Raises:
        InputError: it cannot be made, or has the name of a file.
    """
    if option:
        check_folder_name(folder, option)
    try:
        folder.mkdir(parents=True, exist_ok=may_exist)
    except OSError as error:
        named = f"{option} {folder}" if option else folder
        raise InputError(f"{named}: the folder cannot be made: {error.strerror}") from error
    return folder


def check_folder_name(folder: Path, option: str) -> None:
    """See that a name is not that of a file.

    Args:
        folder: its path.
        option: of the command line that names it.

    Raises:
        InputError: it is a file, or is not there and has the ending of one.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{option} {folder}: is a file, the name of a folder was expected")
    if FILE_ENDING.fullmatch(folder.suffix) and not folder.exists():
        raise InputError(
            f"{option} {folder}: no {folder.suffix} file is written, the name of a folder was expected; "
            f"name it {folder.stem}"
        )
