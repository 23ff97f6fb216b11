"""Process of a node, `python -m NODE [settings.toml]`: its entry, its log, and the last error handler of every process.

A line of the log, on standard error, is text for people, or a JSON object for programs that collect logs: the time is
UTC to the microsecond (ISO 8601), `event` names the event, `level` its severity, and every other key is a field of that
event. A line that the system refuses, as on a full disk, is lost: a log that cannot be written ends no node. The next
line that can be written says how many were lost.

An unhandled error ends in one line and an exit code. Unusable input, and a file or disk that the system refuses, end
with 2; a record that holds too little to be judged ends with 3. Everything else is a fault of this software: it ends
with 70, and the line names a file with the traceback. A node that ends for a reason that can pass without a person ends
with 1, so that a supervisor restarts it.
"""

import errno
import io
import os
import platform
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TextIO, TypeVar, cast

import msgspec

from reactorwatch.errors import InputError, UnavailableError, describe_exception
from reactorwatch.runtime.config import BusConfig, LogConfig, MetricsConfig, read_settings, section
from reactorwatch.terminal import printable
from reactorwatch.version import this_build

if TYPE_CHECKING:
    from structlog.typing import EventDict, Processor

Config = TypeVar("Config", bound=msgspec.Struct)

SUPERVISED = "--supervised"
"""Last argument of a node that ends, as by SIGTERM, when its standard input does: its supervisor has ended."""


def main(
    module: str, table: str, kind: type[Config], run: Callable[..., object], **others: type[msgspec.Struct]
) -> int:
    """Read the settings file that the command line names, and run the node.

    Args:
        module: module of the node, for the usage line.
        table: name of the node's table in the settings file.
        kind: class of its settings.
        run: runs the node, with its settings, those of the bus and of the metrics, and others by name.
        others: classes of other settings, by the name of their table.

    Returns:
        The exit code, see `guard`.
    """
    arguments = sys.argv[1:]
    if arguments[-1:] == [SUPERVISED]:
        arguments.pop()
        threading.Thread(target=_end_with_supervisor, name="supervisor", daemon=True).start()
    if len(arguments) > 1:
        print_error(table, f"usage: python -m {module} [settings.toml]")
        return UNUSABLE
    configure_log()

    def run_node() -> int:
        tables = read_settings(Path(arguments[0]) if arguments else None)
        configure_log(as_json=section(LogConfig, "log", tables, {}).format == "json")
        run(
            section(kind, table, tables, {}),
            section(BusConfig, "bus", tables, {}),
            section(MetricsConfig, "metrics", tables, {}),
            **{name: section(other, name, tables, {}) for name, other in others.items()},
        )
        return 0

    return guard(table, run_node)


def _end_with_supervisor() -> None:
    while os.read(sys.stdin.fileno(), 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


_MULTILINE = frozenset({"exception", "stack"})
"""Fields with tracebacks."""


def _escape(_logger: object, _method: str, event: "EventDict") -> "EventDict":
    """Make texts of a line safe for a terminal; the JSON renderer escapes by itself."""
    return {
        printable(name): printable(value) if isinstance(value, str) and name not in _MULTILINE else value
        for name, value in event.items()
    }


class LogFile(io.TextIOBase):
    """File of the log; its `write` never fails.

    Args:
        stream: standard error, or what takes its place.

    Attributes:
        lost: number of lines that could not be written since the last one that could.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream, self.lost = _without_buffer(stream), 0

    def write(self, line: str) -> int:
        """Write a line, or count it; returns the number of its characters."""
        lost = f"lines of the log that could not be written: {self.lost}\n" if self.lost else ""
        try:
            self._stream.write(lost + line)
            self._stream.flush()
        except OSError:
            self.lost += 1
        else:
            self.lost = 0
        return len(line)


def _without_buffer(stream: TextIO) -> TextIO:
    """The stream without a buffer, in which a line that was refused would stay; itself if it is no file."""
    try:
        descriptor = stream.fileno()
    except (OSError, AttributeError):
        return stream
    raw = cast(BinaryIO, io.FileIO(descriptor, "w", closefd=False))
    return io.TextIOWrapper(raw, encoding=stream.encoding, errors=stream.errors, write_through=True)


def configure_log(level: int = 20, *, as_json: bool = False) -> None:
    """Send the log to standard error.

    Args:
        level: the least severe level that is logged, as in `logging`; 20: information.
        as_json: write a JSON object a line; else coloured for people on a terminal, plain `key=value` elsewhere.
    """
    import structlog  # only here: with asyncio and rich it is half of the start of `--help`
    from structlog.tracebacks import ExceptionDictTransformer

    form: list[Processor] = [
        structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False),
        _escape,
        structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), pad_event_to=0),
    ]
    if as_json:
        form = [
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.ExceptionRenderer(ExceptionDictTransformer(show_locals=False)),
            structlog.processors.JSONRenderer(default=str),
        ]
    structlog.configure(
        processors=[structlog.processors.add_log_level, *form],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.WriteLoggerFactory(cast(TextIO, LogFile(sys.stderr))),
    )


EXIT_CODE = 70
"""EX_SOFTWARE of sysexits.h, used for no other reason."""

INTERRUPTED = 130
"""Exit code of a process that Ctrl-C ended out of order: 128 and the number of the signal."""

UNUSABLE = 2
"""Exit code for unusable input, or a file that the system refuses."""

_NAMES = "EACCES EDQUOT EFBIG EIO EISDIR ELOOP EMFILE ENAMETOOLONG ENFILE ENOSPC ENOTDIR EPERM EROFS"
_SYSTEM_ERRORS = frozenset(getattr(errno, name) for name in _NAMES.split(" "))
"""Errors of a file or a disk, not of this software."""


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
    if len(reason) > 200:
        reason = f"{reason[:200]}…"
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
