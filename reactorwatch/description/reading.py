"""Hints on how to read the files of a process, where guessing does not do."""

import re
from dataclasses import dataclass
from typing import Literal, get_args
from zoneinfo import ZoneInfo

from reactorwatch.errors import InputError

TimeUnit = Literal["s", "min", "h", "iso"]

SECONDS = {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86_400.0}
"""Units of a period, in seconds."""

_PERIOD = re.compile(r"\s*(\d+\.?\d*|\.\d+)\s*([a-z]+)\s*")


@dataclass(frozen=True)
class Reading:
    """Hints on how to read the files of a process; a hint that is None is guessed for each file.

    Attributes:
        time_column: name or number (from 1) of the column of times.
        period_s: interval between rows in seconds, for a file without times.
        time_unit: unit of bare numbers in the column of times, or `iso` for dates.
        zone: time zone of local timestamps, such as `Europe/Berlin`.
        time_format: form of timestamps, as `datetime.strptime` takes it.
        header: whether the first row names the columns.
        separator: what stands between two cells.
        decimal: the decimal mark, `.` or `,`.
        transposed: whether each row of the file is a signal.
        missing: cells that mean that nothing was measured, beside empty ones.

    Raises:
        InputError: a value breaks a rule.
    """

    time_column: str | int | None = None
    period_s: float | None = None
    time_unit: str | None = None
    zone: str | None = None
    time_format: str | None = None
    header: bool | None = None
    separator: str | None = None
    decimal: str | None = None
    transposed: bool | None = None
    missing: tuple[str | float, ...] = ()

    def __post_init__(self) -> None:
        if self.period_s is not None and not 0 < self.period_s < float("inf"):
            raise InputError(f"period must be positive, got {self.period_s:g} s")
        if self.period_s is not None and self.time_column is not None:
            raise InputError(
                f"a file has a column of times or a period, got column {self.time_column!r} and period "
                f"{self.period_s:g} s; leave one out"
            )
        if self.time_unit is not None and self.time_unit not in get_args(TimeUnit):
            raise InputError(f"unit of time must be one of {', '.join(get_args(TimeUnit))}, got {self.time_unit!r}")
        if self.decimal not in (None, ".", ","):
            raise InputError(f"decimal must be '.' or ',', got {self.decimal!r}")
        if self.separator is not None and len(self.separator) != 1:
            raise InputError(f"separator must be one character, got {self.separator!r}")
        if self.separator is not None and self.separator == self.decimal:
            raise InputError(f"separator and decimal must differ, got {self.separator!r} for both")
        if self.zone is not None:
            check_zone(self.zone)


def check_zone(name: str) -> str:
    """Check that a time zone is known; returns its name.

    Raises:
        InputError: it is not.
    """
    try:
        ZoneInfo(name)
    except (KeyError, ValueError, OSError) as error:  # unknown, or no name of a file
        raise InputError(f"zone must be a time zone such as 'Europe/Berlin' or 'UTC', got {name!r}") from error
    return name


def parse_period(text: str) -> float:
    """Interval in seconds from a text such as `4 s` or `0.5 min`.

    Raises:
        InputError: it is no number with a unit of time.

    >>> parse_period("4 s")
    4.0
    """
    match = _PERIOD.fullmatch(text)
    if match is None or match[2] not in SECONDS or not 0 < float(match[1]) * SECONDS[match[2]] < float("inf"):
        raise InputError(
            f"period must be a positive number with a unit ({', '.join(SECONDS)}), such as '4 s', got {text!r}"
        )
    return float(match[1]) * SECONDS[match[2]]
