"""Input files."""

import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.limits import limits


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
