"""Input files."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from reactorwatch.errors import InputError


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


def list_files(folder: Path, suffix: str) -> list[Path]:
    """List the files in a folder with a suffix, in any case, in the order of their names."""
    return sorted(path for path in folder.iterdir() if path.suffix.lower() == suffix and path.is_file())
