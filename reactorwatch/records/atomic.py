"""Atomic writes: a file is written under a temporary name beside its path, and then renamed."""

import glob
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from reactorwatch.errors import InputError
from reactorwatch.records.output import is_replaceable


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary name to write to; when the block ends, that file replaces `path`.

    When the block raises, `path` is unchanged and the temporary file is removed. The target of a link is replaced, not
    the link.

    Raises:
        InputError: the folder does not exist or cannot be written to, or `path` is no regular file.
    """
    is_replaceable(path)
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp")
    try:
        if not target.parent.is_dir():
            raise InputError(f"cannot write {path}: the folder {target.parent} does not exist")
        temporary.touch()
        temporary.unlink()  # some writers refuse an existing file
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from error
    try:
        with wrap_write_errors(path, temporary):
            yield temporary
            temporary.replace(target)
    except BaseException:
        for rest in temporary.parent.glob(f"{glob.escape(temporary.name)}*"):  # a writer may add a suffix
            rest.unlink()
        raise


def write_durably(path: Path, data: bytes, check: Callable[[], None] = lambda: None) -> None:
    """Replace a file atomically; it is on the disk when this returns.

    Args:
        path: the file.
        data: its new bytes.
        check: called just before the file is replaced; if it raises, `path` is unchanged.

    Raises:
        InputError: see `atomic_write`.
    """
    with atomic_write(path) as temporary:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        check()


@contextmanager
def wrap_write_errors(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Turn the system's errors about a file that is written into an `InputError` of one line.

    Args:
        path: the file, as named in messages.
        temporary: name under which it is written; None: `path`.

    Raises:
        InputError: the file cannot be written; its cause is the system's error.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None and Path(error.filename).name != (temporary or path).name:
            raise  # about another file
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error
    except InputError as error:
        cause = error.__cause__
        if temporary is None or temporary.name not in str(error) or not isinstance(cause, OSError):
            raise
        raise InputError(f"cannot write {path}: {cause.strerror or cause}") from cause
