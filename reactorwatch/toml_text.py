"""TOML documents of bounded size, with or without a byte order mark."""

import tomllib
from typing import Any

from reactorwatch.errors import InputError

MAX_FILE_BYTES = 1_000_000
"""Largest size of a document."""


def parse_toml(content: bytes) -> dict[str, Any]:
    """Parse a TOML document.

    Raises:
        InputError: it is not TOML, too large or too deep to be settings.
    """
    if len(content) > MAX_FILE_BYTES:
        raise InputError(f"must be at most {MAX_FILE_BYTES} bytes to be settings, got {len(content)}")
    try:
        return tomllib.loads(content.decode("utf-8-sig"))
    except RecursionError as error:
        raise InputError("is nested too deeply; settings are tables of values and lists") from error
    except ValueError as error:  # not TOML, not UTF-8, or a number of thousands of digits
        raise InputError(f"is not TOML: {error}") from error
