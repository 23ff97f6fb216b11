"""Timestamps: patterns of dates and times of day, guessed or stated like those of strptime; zones."""

import re
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError

_NAMES = "jan feb mar apr may jun jul aug sep oct nov dec"
_MONTHS = {name: number for number, name in enumerate(_NAMES.split(), start=1)}
_MONTHS |= {"jän": 1, "mär": 3, "mrz": 3, "mai": 5, "okt": 10, "dez": 12}
_MONTHS |= {"ene": 1, "fév": 2, "mrt": 3, "abr": 4, "avr": 4, "mei": 5, "ago": 8, "aoû": 8, "dic": 12, "déc": 12}
_ZONE = r"(?P<z>[Zz]|[A-Za-z]{3,4}|[+-]\d{2}:?(?:\d{2})?)"
_CLOCK = (
    r"(?P<H>\d{1,2}):(?P<M>\d{2})(?::(?P<S>\d{2})(?:[.,](?P<f>\d{1,9}))?)?"
    rf"(?:\s*(?P<p>[AaPp])\.?[Mm]\.?)?(?:\s*{_ZONE})?"
)
_YEAR = r"(?P<y>\d{4}|\d{2})"
_DAY = r"(?P<d>\d{1,2})"
_MONTH_NAME = r"(?P<n>\pL{3,9})\.?"
_DATES = {
    "yyyy-mm-dd": r"(?P<y>\d{4})[-/.](?P<m>\d{1,2})[-/.](?P<d>\d{1,2})",
    **{f"{{}}{sign}{{}}{sign}yyyy": rf"(?P<a>\d{{1,2}})[{sign}](?P<b>\d{{1,2}})[{sign}]{_YEAR}" for sign in "./-"},
    "dd-Mon-yyyy": rf"{_DAY}[-. ]\s?{_MONTH_NAME}[- ]{_YEAR}",
    "Mon dd, yyyy": rf"{_MONTH_NAME} {_DAY},? (?P<y>\d{{4}})",
}
_DIRECTIVES = {
    "%Y": r"(?P<y>\d{4})",
    "%y": r"(?P<y>\d{2})",
    "%m": r"(?P<m>\d{1,2})",
    "%d": _DAY,
    "%b": _MONTH_NAME,
    "%B": _MONTH_NAME,
    "%H": r"(?P<H>\d{1,2})",
    "%I": r"(?P<H>\d{1,2})",
    "%M": r"(?P<M>\d{1,2})",
    "%S": r"(?P<S>\d{1,2})",
    "%f": r"(?P<f>\d{1,9})",
    "%p": r"(?P<p>[AaPp])\.?[Mm]\.?",
    "%z": _ZONE,
    "%Z": _ZONE,
    "%%": "%",
}
_OFFSETS_H = {"WET": 0, "BST": 1, "WEST": 1, "CET": 1, "MEZ": 1, "CEST": 2, "MESZ": 2}
_OFFSETS_H |= {"EET": 2, "EEST": 3, "EST": -5, "EDT": -4, "CST": -6, "CDT": -5, "MST": -7, "MDT": -6, "PST": -8}
_OFFSETS_H |= {"PDT": -7, "JST": 9}

HOUR_NS = 3_600_000_000_000
DAY_NS = 24 * HOUR_NS

ORDERS = DAY_FIRST, MONTH_FIRST = "day-first", "month-first"
_FIXED_ZONE = re.compile(r"(?:UTC|GMT)?([+-])(\d{1,2})(?::?(\d{2}))?")


class Pattern(NamedTuple):
    """Form of timestamps: its name for people, and a regular expression of RE2 with named groups."""

    name: str
    regex: str

    @property
    def has_date(self) -> bool:
        """True if the day is part of it."""
        return "(?P<y>" in self.regex

    @property
    def has_clock(self) -> bool:
        """True if the time of day is part of it."""
        return "(?P<H>" in self.regex


CLOCK = Pattern("hh:mm:ss", rf"^\s*{_CLOCK.replace('1,2', '1,5', 1)}\s*$")
"""A time of day, or hours since the start."""
DATES = tuple(Pattern(name, rf"^\s*{date}\s*$") for name, date in _DATES.items())
DATE_TIMES = (
    *(
        Pattern(f"{name} hh:mm:ss", rf"^\s*(?:\pL{{2,10}}[.,]?\s+)?{date}[T\s,]+{_CLOCK}\s*$")
        for name, date in _DATES.items()
    ),
    Pattern(
        "yyyymmddThhmmss",
        r"^\s*(?P<y>(?:19|20)\d\d)(?P<m>0\d|1[0-2])(?P<d>[0-3]\d)[T _-]?(?P<H>[0-2]\d):?(?P<M>[0-5]\d):?(?P<S>[0-5]\d)"
        rf"{_ZONE}?\s*$",
    ),
    Pattern(
        "Mon dd hh:mm:ss yyyy",
        rf"^\s*(?:\pL{{2,10}}[.,]?\s+)?{_MONTH_NAME}\s+{_DAY}\s+{_CLOCK}\s+(?P<y>\d{{4}})\s*$",
    ),
)
PATTERNS = (*DATE_TIMES, *DATES, CLOCK)


class Instants(NamedTuple):
    """Parsed timestamps, each of shape (rows,)."""

    local_ns: NDArray[np.int64]
    offset_s: NDArray[np.float64]
    valid: NDArray[np.bool_]


@cache
def _compile(pattern: Pattern) -> re.Pattern[str]:
    """The expression for Python, which knows no classes of Unicode letters."""
    return re.compile(pattern.regex.replace(r"\pL", r"[^\W\d_]"))


def guess_pattern(cells: list[str], patterns: tuple[Pattern, ...] = PATTERNS) -> Pattern | None:
    """Pattern of most of some cells; None if they are no such timestamps."""
    filled = [cell for cell in cells if cell.strip()]
    for pattern in patterns:
        if filled and sum(_compile(pattern).match(cell) is not None for cell in filled) > len(filled) / 2:
            return pattern
    return None


def stated_pattern(text: str) -> Pattern:
    """Pattern of a format in the language of strptime."""
    text_in_full = text.replace("%T", "%H:%M:%S").replace("%F", "%Y-%m-%d").replace("%R", "%H:%M")
    regex = ""
    for part in re.findall(r"%.?|[^%]+", text_in_full):
        if part.startswith("%") and part not in _DIRECTIVES:
            raise InputError(f"--time-format {text!r}: unknown directive {part!r} (valid: {' '.join(_DIRECTIVES)})")
        regex += _DIRECTIVES.get(part) or re.escape(part)
    try:
        re.compile(regex.replace(r"\pL", r"\w"))
    except re.error as error:
        raise InputError(f"--time-format {text!r}: each part once, got {error}") from error
    return Pattern(text, f"^\\s*{regex}\\s*$")


def parse(cells: Any, pattern: Pattern, dates: str | None = None) -> tuple[Instants, str | None]:
    """Parse cells to times.

    Args:
        cells: strings, a pyarrow array of shape (rows,).
        pattern: form of the timestamps.
        dates: order of day and month where it is not written, one of `ORDERS`; None: by all cells.

    Returns:
        The times, and the name of the pattern with the order of day and month; None: it is ambiguous, and taken as
        day-first in the times.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    if pattern.name.startswith("yyyy-mm-dd"):
        for zone in (None, "UTC"):
            try:
                times = pc.cast(cells, pa.timestamp("ns", zone))
            except pa.ArrowInvalid:  # another form of ISO 8601, or some cells are no timestamps
                continue
            offset_s = np.full(len(cells), np.nan if zone is None else 0.0)
            local_ns = np.asarray(pc.fill_null(times.cast(pa.int64()), 0))
            return Instants(local_ns, offset_s, np.asarray(times.is_valid())), pattern.name
    groups = pc.extract_regex(cells, pattern.regex)
    names = {field.name for field in groups.type}
    valid = np.asarray(groups.is_valid())

    def text(name: str) -> Any:
        return pc.struct_field(groups, name)

    def number(name: str, default: int = 0, digits: int = 0) -> NDArray[np.int64]:
        if name not in names:
            return np.full(len(cells), default)
        found = pc.utf8_rpad(text(name), digits, "0") if digits else text(name)
        found = pc.if_else(pc.equal(pc.utf8_length(text(name)), 0), None, found)
        return np.asarray(pc.fill_null(pc.cast(found, pa.int64()), default))

    year, month, day = number("y", 1970), number("m", 1), number("d", 1)
    hour, minute, second = number("H"), number("M"), number("S")
    form: str | None = pattern.name
    year = year + np.where(year < 100, np.where(year < 70, 2000, 1900), 0)
    if "n" in names:
        values = pc.utf8_slice_codeunits(pc.utf8_lower(text("n")), 0, 3)
        index = pc.index_in(values, pa.array(list(_MONTHS)))
        month = np.array([*_MONTHS.values(), 0])[np.asarray(pc.fill_null(index, len(_MONTHS)))]
    if "p" in names:
        half = np.asarray(pc.fill_null(pc.utf8_lower(text("p")), "").to_numpy(zero_copy_only=False), dtype=object)
        hour = np.where(half == "", hour, hour % 12 + 12 * (half == "p"))
    if "a" in names:
        one, other = number("a", 1), number("b", 1)
        clock_s = (hour * 60 + minute) * 60 + second
        order = dates or _find_order(year[valid], one[valid], other[valid], clock_s[valid])
        order = DAY_FIRST if order is None and pattern.name.startswith("{}.") else order  # points are European
        day, month = (other, one) if order == MONTH_FIRST else (one, other)
        form = pattern.name.format(*(("mm", "dd") if order == MONTH_FIRST else ("dd", "mm"))) if order else None
    days = _days(year, month, day)
    one = np.ones_like(day)
    in_month = _days(year + month // 12, month % 12 + 1, one) - _days(year, month, one)
    in_range = (month >= 1) & (month <= 12) & (day >= 1) & (day <= in_month) & (minute < 60) & (second <= 60)
    if pattern.has_date:
        in_range &= hour <= 24
    local_ns = ((days * 24 + hour) * 60 + minute) * 60 + second
    local_ns = local_ns * 1_000_000_000 + number("f", 0, 9)
    return Instants(
        local_ns, _offsets(text("z")) if "z" in names else np.full(len(cells), np.nan), valid & in_range
    ), form


def _days(year: NDArray[np.int64], month: NDArray[np.int64], day: NDArray[np.int64]) -> NDArray[np.int64]:
    """Days since 1970-01-01."""
    months = (year - 1970) * 12 + month - 1
    return np.asarray(months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64) + day - 1)


def _find_order(
    year: NDArray[np.int64], first: NDArray[np.int64], second: NDArray[np.int64], clock_s: NDArray[np.int64]
) -> str | None:
    """Order of day and month in dates such as 03/04/2026; None: both are possible.

    Months are at most 12, times are in order, and rows of several a date are days apart, not months.
    """
    if (first > 12).any() or (second > 12).any() or np.array_equal(first, second):
        return MONTH_FIRST if (second > 12).any() and not (first > 12).any() else DAY_FIRST
    times_s = [_days(year, month, day) * 86_400 + clock_s for day, month in ((first, second), (second, first))]
    in_order = [bool((np.diff(time) >= 0).all() or (np.diff(time) <= 0).all()) for time in times_s]
    if in_order[0] != in_order[1]:
        return ORDERS[in_order.index(True)]
    spans = [int(np.ptp(time)) for time in times_s]
    dates = 1 + np.count_nonzero(np.diff(first) | np.diff(second))
    return None if spans[0] == spans[1] or 2 * dates > first.size else ORDERS[int(np.argmin(spans))]


def _offsets(cells: Any) -> NDArray[np.float64]:
    """Offsets from UTC in seconds, shape (rows,); NaN where no offset is written or its name is unknown."""
    encoded = cells.dictionary_encode()
    values: list[float] = []
    for text in encoded.dictionary.to_pylist():
        offset_s = fixed_offset_s(text.rstrip(":"))
        values.append(_OFFSETS_H.get(text.upper(), np.nan) * 3600 if offset_s is None else offset_s)
    index = np.asarray(encoded.indices.fill_null(len(values)))
    return np.asarray(np.array([*values, np.nan], dtype=np.float64)[index], dtype=np.float64)


def fixed_offset_s(zone: str) -> int | None:
    """Seconds by which a zone such as `+01:00` or `UTC+1` is ahead of UTC; None for a named zone."""
    if zone.upper() in ("UTC", "GMT", "Z"):
        return 0
    match = _FIXED_ZONE.fullmatch(zone.upper())
    if match is None:
        return None
    return (1 if match[1] == "+" else -1) * (int(match[2]) * 3600 + int(match[3] or 0) * 60)


def to_utc(local_ns: NDArray[np.int64], zone: str, refuse: Callable[[int, str], NoReturn]) -> NDArray[np.int64]:
    """Convert local times to UTC.

    When the clock is set back, local times of an hour occur twice. Rows up to the step back are summer time, those
    after it winter time; without a step back, the rows join the neighbour that they fit without a gap.

    Args:
        local_ns: nanoseconds since 1970 on the local clock, shape (rows,).
        zone: name of the zone, or a fixed offset.
        refuse: raises the error for a row and a rule.

    Returns:
        Nanoseconds since 1970 UTC, shape (rows,).

    Raises:
        InputError: the system does not know the zone.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    offset_s = fixed_offset_s(zone)
    if offset_s is not None:
        return local_ns - offset_s * 1_000_000_000
    local = pa.array(local_ns).cast(pa.timestamp("ns"))
    try:
        early, late = (
            np.array(pc.assume_timezone(local, zone, ambiguous=side, nonexistent=side).cast(pa.int64()))
            for side in ("earliest", "latest")
        )
    except pa.ArrowInvalid as error:
        raise InputError(
            f"--zone {zone}: is not in this system's database of time zones; install tzdata, or state an offset"
        ) from error
    skipped = np.flatnonzero(late - early == 1)  # 1 ns before the step, and just after it
    if skipped.size:
        refuse(
            int(skipped[0]),
            f"expected a time that exists in {zone}, where clocks are set forward then (--zone UTC or +01:00, "
            "if this clock knows no summer time)",
        )
    twice = np.flatnonzero(late > early)
    for stretch in np.split(twice, np.flatnonzero(np.diff(twice) > 1) + 1) if twice.size else ():
        first, end = int(stretch[0]), int(stretch[-1]) + 1
        steps = np.diff(local_ns[first:end])  # among several, one of 0 is a duplicate row
        back = np.flatnonzero((steps < 0) | ((steps == 0) & (steps.size == 1)))
        if back.size:
            second = first + int(back[0]) + 1
            early[second:end] = late[second:end]
            continue
        gaps = []
        for times in (early, late):
            before = times[first] - early[first - 1] if first else 0
            after = early[end] - times[end - 1] if end < early.size else 0
            gaps.append(max(before, after))
        if gaps[0] == gaps[1]:
            refuse(
                first,
                f"expected a time that is unique in {zone}, where this hour occurs twice and the rows fit both "
                "(--zone +01:00, for instance, states the offset)",
            )
        if gaps[0] > gaps[1]:
            early[first:end] = late[first:end]
    return early
