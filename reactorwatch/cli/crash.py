"""The report of an error that is a fault of this software: a file with the traceback, and one line that names it."""

import os
import platform
import sys
import tempfile
import traceback
from contextlib import suppress
from pathlib import Path

from reactorwatch import __version__

EXIT_CODE = 70
"""EX_SOFTWARE of sysexits.h: no command ends with it for another reason."""

_LONGEST_REASON = 200


def report_crash(error: BaseException) -> str:
    """Write the report of an error.

    Args:
        error: that the command could not deal with.

    Returns:
        A line for people: the error, and the path of the report; where none can be written, the place in the code.
    """
    reason = " ".join(f"{type(error).__name__}: {error}".split())
    if len(reason) > _LONGEST_REASON:
        reason = f"{reason[:_LONGEST_REASON]}…"
    path = _write(_report(error))
    if path is not None:
        where = f"please send {path}, which says where, and the files that it names"
    else:
        frames = traceback.extract_tb(error.__traceback__)
        where = f"please report {frames[-1].filename}:{frames[-1].lineno}" if frames else "please report it"
    return f"this is a fault of the program and not yours: {reason}; {where}"


def _report(error: BaseException) -> str:
    lines = [
        f"reactorwatch {__version__}, Python {platform.python_version()}, {platform.platform()}",
        f"folder: {Path.cwd()}",
        f"command: {sys.argv}",
        "",
        *traceback.format_exception(error),
    ]
    return "\n".join(line.rstrip("\n") for line in lines) + "\n"


def _write(text: str) -> Path | None:
    """The file in the system's folder for temporary files, which only its owner can read; None if it cannot be."""
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
