"""File format as the user states it: whatever is not stated is guessed from the file."""

import math
import re
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.limits import limits

TIME_COLUMN, RUN_COLUMN, CLOCK_COLUMN = "time_min", "run", "time"
"""Columns that a written table has beside the signals: minutes, the run of each row if there are several, and clock
time if it is asked for."""

SECONDS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
"""Seconds in each unit of time."""

TIME_UNITS = (*SECONDS, "iso")
SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "\\t": "\t", "blank": " ", "blanks": " ", "pipe": "|"}
_PERIOD = re.compile(r"(\d+(?:\.\d+)?)\s*([a-z]+)")

AUTO = "auto"
METHODS = MEAN, LAST, INTERPOLATED, SPARSE = "mean", "last", "interpolated", "sparse"
"""Values of resampled rows: the mean over a period, the last value up to the row, the line between the values before
and after it, or the values near the row and none in the other rows."""


class ResampleRule(NamedTuple):
    """Period and methods by which rows are resampled.

    Attributes:
        period_s: the period in seconds; None: that of the fastest signal.
        method: method of the signals that are not named; None: by the kind of the signal.
        methods: method by signal.
    """

    period_s: float | None
    method: str | None
    methods: dict[str, str]


@dataclass(frozen=True)
class FileFormat:
    """Statements about a file that override the guesses. Names in brackets are the options of the command line.

    Attributes:
        time: header or number (from 1) of the time column (`--time`).
        time_unit: unit of a numeric time column: ns, us, ms, s, min, h or d; `iso` for timestamps (`--time-unit`).
        zone: time zone of local timestamps, such as `Europe/Berlin` or `+01:00` (`--zone`).
        time_format: format of timestamps, such as `%d.%m.%Y %H:%M:%S` (`--time-format`).
        dates: order of day and month in dates such as 03/04/2026, `month-first` or `day-first` (`--dates`).
        period: sampling period of rows without a usable time column, such as `4 s` (`--period`).
        missing: cells that mean "not measured", beside the usual ones (`--missing`).
        separator: the character between cells, or its name (`--separator`).
        decimal: `.` or `,` (`--decimal`).
        header: whether the file has a header (`--header`, `--no-header`).
        transposed: whether each row is a signal (`--transposed`, `--no-transposed`).
        tag: header or number of the column of tags in a table with a row for each value, or several with commas
            between; `none`: each signal has a column (`--tag`).
        value: header or number of the column of values in such a table (`--value`).
        sheet: name or number (from 1) of the sheet of a workbook (`--sheet`).
        quality_good: qualities of usable values, alone or with commas between; `*`: all (`--quality-good`).
        resample: period of the rows that are made of those of the file, such as `10 s`, or `auto`; methods may follow
            with commas between, for all signals or as signal=method: `10 s,T=interpolated` (`--resample`).

    Raises:
        InputError: a value is not one of those listed.
    """

    time: str | None = None
    time_unit: str | None = None
    zone: str | None = None
    time_format: str | None = None
    dates: str | None = None
    period: str | None = None
    missing: tuple[str, ...] = ()
    separator: str | None = None
    decimal: str | None = None
    header: bool | None = None
    transposed: bool | None = None
    tag: str | None = None
    value: str | None = None
    sheet: str | None = None
    quality_good: tuple[str, ...] = ()
    resample: str | None = None

    def __post_init__(self) -> None:
        limits().check("missing", '--missing: the number of cells that mean "not measured"', len(self.missing))
        if self.time_unit is not None and self.time_unit not in TIME_UNITS:
            raise InputError(describe_unknown("--time-unit", self.time_unit, TIME_UNITS))
        if self.dates is not None:
            from reactorwatch.records.timestamps import ORDERS  # only here: it imports NumPy, and help is to be fast

            if self.dates not in ORDERS:
                raise InputError(describe_unknown("--dates", self.dates, ORDERS))
        if self.decimal is not None and self.decimal not in (".", ","):
            raise InputError(f"--decimal must be '.' or ',', got {self.decimal!r}")
        if self.separator is not None:
            separator = SEPARATORS.get(self.separator, self.separator)
            if len(separator) != 1 or separator in '"\r\n' or separator.isalnum():
                raise InputError(f"--separator must be one character, 'tab' or 'blank', got {self.separator!r}")
            object.__setattr__(self, "separator", separator)
            if separator == self.decimal:
                raise InputError(f"--separator and --decimal must differ, got {separator!r} for both")
        self.period_s, self.resample_rule  # noqa: B018 # check them
        if self.period is not None and (self.value or self.tag not in (None, "none")):
            raise InputError(f"--tag and --value need a time column, got --period {self.period!r}; state --time NAME")
        if self.zone is not None:
            _check_zone(self.zone)
        if self.time_format is not None:
            from reactorwatch.records.timestamps import stated_pattern

            stated_pattern(self.time_format)

    def override(self, other: "FileFormat") -> "FileFormat":
        """Copy with the statements of another one in place of its own, where it has any."""
        given = {item.name: value for item in fields(other) if (value := getattr(other, item.name)) not in (None, ())}
        if "time" in given or "period" in given:  # a file has one of the two
            given = {"time": None, "period": None} | given
        return replace(self, **given)

    @property
    def period_s(self) -> float | None:
        """Sampling period in seconds; None: the file has a time column."""
        return None if self.period is None else _parse_period("--period", self.period)

    @property
    def resample_rule(self) -> ResampleRule | None:
        """Period and methods of the rows; None: the rows are those of the file."""
        return None if self.resample is None else parse_resampling(self.resample, "--resample")


GUESS = FileFormat()
"""Nothing is stated, all is guessed."""


def parse_resampling(text: str, option: str) -> ResampleRule:
    """Parse a period, or `auto`, with methods behind it.

    Raises:
        InputError: the period or a method is none; the text begins with the option.
    """
    period, *others = (part.strip() for part in text.split(","))
    method, methods = None, dict[str, str]()
    for part in others:
        name, is_named, kind = part.rpartition("=")
        if kind.strip() not in METHODS:
            raise InputError(describe_unknown(f"{option}: method", kind.strip(), METHODS))
        if is_named:
            methods[name.strip()] = kind.strip()
        else:
            method = kind
    return ResampleRule(None if period == AUTO else _parse_period(option, period), method, methods)


def _parse_period(option: str, text: str) -> float:
    """Seconds of a period."""
    match = _PERIOD.fullmatch(text.strip())
    seconds = float(match[1]) * SECONDS.get(match[2], math.nan) if match else math.nan
    if not 0 < seconds < math.inf:
        either = ", or auto" if option == "--resample" else ""
        raise InputError(f"{option} must be a positive number with its unit, such as 4 s{either}, got {text!r}")
    return seconds


def _check_zone(zone: str) -> None:
    from zoneinfo import ZoneInfo

    from reactorwatch.records.timestamps import fixed_offset_s

    if fixed_offset_s(zone) is not None:
        return
    try:
        ZoneInfo(zone)
    except (KeyError, ValueError, OSError) as error:  # a name that is not found, malformed, or a folder of the database
        raise InputError(f"--zone must be a time zone such as Europe/Berlin or +01:00, got {zone!r}") from error
