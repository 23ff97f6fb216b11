"""Log of a node: one line an event, on standard error.

A line is text for people, or a JSON object for programs that collect logs: the time is UTC to the microsecond (ISO
8601), `event` names the event, `level` its severity, and every other key is a field of that event.

A line that the system refuses, as on a full disk, is lost: a log that cannot be written ends no node. The next line
that can be written says how many were lost.
"""

import io
import logging
import sys
from typing import BinaryIO, TextIO, cast

import structlog
from structlog.tracebacks import ExceptionDictTransformer
from structlog.typing import EventDict, Processor

from reactorwatch.terminal import printable

_MULTILINE = frozenset({"exception", "stack"})
"""Fields with tracebacks."""


def _escape(_logger: object, _method: str, event: EventDict) -> EventDict:
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
        said = f"lines of the log that could not be written: {self.lost}\n" if self.lost else ""
        try:
            self._stream.write(said + line)
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


def configure(level: int = logging.INFO, *, as_json: bool = False) -> None:
    """Send the log to standard error.

    Args:
        level: the least severe level that is logged.
        as_json: write a JSON object a line; else coloured for people on a terminal, plain `key=value` elsewhere.
    """
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
