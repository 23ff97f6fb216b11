"""A file appears whole or not at all: it is written beside its place and then renamed into it."""

import glob
import os
from collections.abc import Iterator
from contextlib import contextmanager
from errno import EDQUOT, ENOSPC
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.records.output import is_replaceable


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to; what is there when the block ends takes the place of `path`.

    When the block raises, `path` is as it was and nothing is left beside it. A link stays: the file that it leads to
    is replaced.

    Raises:
        InputError: the folder does not exist or cannot be written to, or `path` is no regular file.
    """
    is_replaceable(path)
    place = Path(os.path.realpath(path)) if path.is_symlink() else path
    temporary = place.with_name(f".{place.name}.{os.getpid()}.tmp")
    try:
        if not place.parent.is_dir():
            raise InputError(f"cannot write {path}: the folder {place.parent} does not exist")
        temporary.touch()
        temporary.unlink()  # some writers refuse a file that is there
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error
    try:
        with cannot_write(path, temporary):
            yield temporary
            temporary.replace(place)
    except BaseException:
        for left in temporary.parent.glob(f"{glob.escape(temporary.name)}*"):  # a writer may have a name of its own
            left.unlink()
        raise


@contextmanager
def cannot_write(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """While a file is written: that it cannot be, for lack of room perhaps, is one line about it.

    Args:
        path: the file, as people know it.
        temporary: the name that it is written under meanwhile; None: the same.

    Raises:
        InputError: it cannot be written; its cause is the system's error.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None and Path(error.filename).name != (temporary or path).name:
            raise  # of another file
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error
    except InputError as error:
        cause = error.__cause__
        if temporary is None or temporary.name not in str(error) or not isinstance(cause, OSError):
            raise
        raise InputError(f"cannot write {path}: {cause.strerror or cause}") from cause


def is_full(error: BaseException | None) -> bool:
    """Whether something could not be written because there is no room, which may change, and for no other reason."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (ENOSPC, EDQUOT):
            return True
        error = error.__cause__
    return False
