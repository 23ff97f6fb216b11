"""A folder that is to be written into."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.records.atomic import cannot_write, replacing
from reactorwatch.records.output import check_folder_name


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


@contextmanager
def filling(folder: Path, option: str = "") -> Iterator[Path]:
    """A folder beside `folder` to write files to, which are moved there when the block ends.

    When the block raises, `folder` is as it was, or not there if it was not, and nothing is left beside it.

    Args:
        folder: its path; made if it is not there.
        option: as for `make_folder`.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    beside = next(path for path in (folder, *folder.absolute().parents) if path.is_dir())
    temporary = beside / f".{folder.name}.{os.getpid()}.tmp"
    try:
        temporary.mkdir()
    except OSError as error:
        raise InputError(f"{f'{option} ' if option else ''}{folder}: cannot be written to: {error.strerror}") from error
    try:
        yield temporary
        make_folder(folder, option)
        for file in sorted(path for path in temporary.rglob("*") if path.is_file()):
            target = folder / file.relative_to(temporary)
            make_folder(target.parent)
            with replacing(target) as place, cannot_write(target):
                file.replace(place)
    except InputError as error:
        raise InputError(str(error).replace(str(temporary), str(folder))) from error.__cause__
    finally:
        shutil.rmtree(temporary)
