"""Log of a node: one line an event, on standard error.

A line is text for people, or a JSON object for programs that collect logs: the time is UTC to the microsecond (ISO
8601), `event` names the event, `level` its severity, and every other key is a field of that event.
"""

import logging
import sys

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
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
    )
