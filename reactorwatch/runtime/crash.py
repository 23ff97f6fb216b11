"""Last error handler of every process: an unhandled error ends in one line and an exit code.

Unusable input, and a file or disk that the system refuses, end with 2; a record that holds too little to be judged ends
with 3. Everything else is a fault of this software: it ends with 70, and the line names a file with the traceback. A
node that ends for a reason that can pass without a person ends with 1, so that a supervisor restarts it.
"""

import errno
import os
import platform
import sys
import tempfile
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from reactorwatch.errors import InputError, UnavailableError, describe_exception
from reactorwatch.terminal import printable
from reactorwatch.version import this_build

EXIT_CODE = 70
"""EX_SOFTWARE of sysexits.h, used for no other reason."""

INTERRUPTED = 130
"""Exit code of a process that Ctrl-C ended out of order: 128 and the number of the signal."""

UNUSABLE = 2
"""Exit code for unusable input, or a file that the system refuses."""

_NAMES = "EACCES EDQUOT EFBIG EIO EISDIR ELOOP EMFILE ENAMETOOLONG ENFILE ENOSPC ENOTDIR EPERM EROFS"
_SYSTEM_ERRORS = frozenset(getattr(errno, name) for name in _NAMES.split(" "))
"""Errors of a file or a disk, not of this software."""

_MAX_REASON = 200


def guard(name: str, run: Callable[[], int]) -> int:
    """Run a program to its end.

    Args:
        name: name of the program, at the start of its line.
        run: the program, which returns its exit code.

    Returns:
        The exit code of the process, after one line on standard error if `run` raised.
    """
    try:
        return run()
    except KeyboardInterrupt:
        return INTERRUPTED
    except (InputError, UnavailableError) as error:
        print_error(name, str(error))
        return error.exit_code
    except Exception as error:  # noqa: BLE001 (only here an unexpected error becomes a report)
        if isinstance(error, OSError) and error.errno in _SYSTEM_ERRORS:
            print_error(name, f"{error.filename or 'standard output cannot be written'}: {error.strerror}")
            return UNUSABLE
        print_error(name, report_crash(error))
        return EXIT_CODE


def print_error(name: str, text: str) -> None:
    """Write one line to standard error; line breaks and control characters are removed.

    Args:
        name: name of the program.
        text: text of the line.
    """
    line = " ".join(text.split())
    with suppress(OSError):  # the exit code remains
        sys.stderr.write(printable(f"{name}: {line}") + "\n")
        sys.stderr.flush()


def report_crash(error: BaseException) -> str:
    """Write the report of an error.

    Args:
        error: the unhandled error.

    Returns:
        A line for people: the error, and the path of the report or, if none can be written, the line of the code.
    """
    reason = " ".join(describe_exception(error).split())
    if len(reason) > _MAX_REASON:
        reason = f"{reason[:_MAX_REASON]}…"
    path = _write(_report(error))
    if path is not None:
        where = f"please send {path}, which says where, and the files that it names"
    else:
        frames = traceback.extract_tb(error.__traceback__)
        where = f"please report {frames[-1].filename}:{frames[-1].lineno}" if frames else "please report it"
    return f"this is a fault of the program and not yours: {reason}; {where}"


def _report(error: BaseException) -> str:
    lines = [
        f"reactorwatch {this_build()}, Python {platform.python_version()}, {platform.platform()}",
        f"folder: {Path.cwd()}",
        f"command: {sys.argv}",
        "",
        *traceback.format_exception(error),
    ]
    return "\n".join(line.rstrip("\n") for line in lines) + "\n"


def _write(text: str) -> Path | None:
    """Write a file that only its owner can read, in the system's temporary folder; None if that fails."""
    with suppress(OSError):
        handle, name = tempfile.mkstemp(prefix="reactorwatch-crash-", suffix=".txt")
        path = Path(name)
        try:
            with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
                file.write(text)
        except OSError:
            path.unlink()
            raise
        return path
    return None
