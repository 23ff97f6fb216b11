"""A file that is to be read, and may not be there."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from reactorwatch.errors import InputError


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """While it is opened and read.

    Raises:
        InputError: there is no such file, or it cannot be read.
    """
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error


def files_of(folder: Path, suffix: str) -> list[Path]:
    """The files in a folder whose names end in a suffix, be it in capitals, in the order of their names."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() == suffix and path.is_file())
