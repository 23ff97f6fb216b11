"""A file appears whole or not at all: it is written beside its place and then renamed into it."""

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
        yield temporary
        temporary.replace(place)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def is_full(error: BaseException | None) -> bool:
    """Whether something could not be written because there is no room, which may change, and for no other reason."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in (ENOSPC, EDQUOT):
            return True
        error = error.__cause__
    return False
