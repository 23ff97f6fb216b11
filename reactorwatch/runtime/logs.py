"""What a node says while it runs: one line an event, to standard error."""

import logging
import sys

import structlog


def configure(level: int = logging.INFO) -> None:
    """Send the log to standard error: coloured for people on a terminal, plain `key=value` elsewhere."""
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="%H:%M:%S", utc=False),
            structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), pad_event_to=0),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
    )
