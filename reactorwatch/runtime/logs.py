"""What a node says while it runs: one line an event, to standard error.

For people a line of text; for programs that collect logs an object, in which the time is that of UTC to the microsecond
(ISO 8601), `event` says what happened, `level` how bad it is, and every other key is a field of that event.
"""

import logging
import sys

import structlog
from structlog.tracebacks import ExceptionDictTransformer
from structlog.typing import EventDict, Processor

from reactorwatch.terminal import printable

_OF_MANY_LINES = frozenset({"exception", "stack"})
"""Fields that are tracebacks of ours."""


def _escape(_logger: object, _method: str, event: EventDict) -> EventDict:
    """Texts of a line for people, as a terminal may have them; a JSON renderer escapes by itself."""
    return {
        printable(name): printable(value) if isinstance(value, str) and name not in _OF_MANY_LINES else value
        for name, value in event.items()
    }


def configure(level: int = logging.INFO, *, as_json: bool = False) -> None:
    """Send the log to standard error.

    Args:
        level: what is less is not said.
        as_json: an object a line; else coloured for people on a terminal, plain `key=value` elsewhere.
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
