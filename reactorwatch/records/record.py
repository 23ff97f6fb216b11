"""Record: times and the columns measured at them. Pure.

A record has several runs if the plant's clock stepped back or the plant was restarted. Rows keep the order of receipt,
and times increase within each run.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reactorwatch.errors import InputError

MINUTE_NS = 60_000_000_000
"""Nanoseconds in a minute: times on the bus and in files are in nanoseconds, those of models in minutes."""

NEVER_NS = 2**63 - 1
"""A time that does not come; the negative one is before all others."""

LARGEST_VALUE = 1e15
"""Values of at least this size are no measurements, and their squares would soon overflow."""

LONGEST_MIN = 2.0**62 / MINUTE_NS
"""Largest time of a row, 146 years: sums of times must still fit 64 bits of nanoseconds."""

GAP_ROWS = 20
"""Gap between two runs in `Record.continuous_min`, in sampling periods: no row is predicted across it."""

MAX_SPANS = 5
"""Runs whose times are named in messages."""


def to_time_ns(minutes: float, zero_ns: int = 0) -> int:
    """Convert minutes to nanoseconds, to the nearest microsecond, so that decimal minutes convert back exactly."""
    return zero_ns + round(minutes * 60e6) * 1000


def to_minutes(time_ns: int, zero_ns: int = 0) -> float:
    """Convert nanoseconds to minutes since a zero.

    >>> to_minutes(to_time_ns(0.3))
    0.3
    """
    return (time_ns - zero_ns) / MINUTE_NS


def format_utc(time_ns: int) -> str | None:
    """Format a time as ISO 8601 in UTC; None if its year has more than four digits.

    >>> format_utc(1_772_352_000_250_000_000)
    '2026-03-01T08:00:00.25Z'
    """
    seconds, rest = divmod(time_ns, 1_000_000_000)
    try:
        text = (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=seconds)).strftime("%Y-%m-%dT%H:%M:%S")
    except OverflowError:
        return None
    return f"{text}{f'.{rest:09d}'.rstrip('0') if rest else ''}Z"


@dataclass(frozen=True)
class Record:
    """One or several measured runs.

    Attributes:
        time_min: times of the rows, shape (rows,), increasing within each run.
        columns: values by signal name, each of shape (rows,), in the signal's unit; NaN: not measured. The input of row
            k is held over [t_k, t_k+1).
        name: name of the source, for messages.
        zero_ns: time from which the minutes are counted, in nanoseconds since 1970-01-01 UTC; 0: unknown.
        first_row: number of the first row in the file, as a text editor counts lines; None: the rows are no lines.
        runs: number of each row's run, shape (rows,), counted from 1; None: one run.
        units: units by signal name, without signals of unknown unit.
        strays: count of samples in no row, because their number or time fits neither those before nor those after.
        read_as: guesses about the file's format, for people; empty: there was nothing to guess.
        excluded: by signal, the sampled values that are no measurements because they are out of the signal's bounds,
            shape (rows,); NaN elsewhere, and `columns` are NaN there.
    """

    time_min: NDArray[np.float64]
    columns: dict[str, NDArray[np.float64]]
    name: str
    zero_ns: int = 0
    first_row: int | None = None
    runs: NDArray[np.intp] | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    strays: int = 0
    read_as: str = ""
    excluded: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for signal, values in (*self.columns.items(), *self.excluded.items()):
            if values.shape != self.time_min.shape:
                raise ValueError(
                    f"column {signal!r} must have as many rows as the times, {self.time_min.size}, got {values.size}"
                )

    @property
    def rows(self) -> int:
        """Number of rows."""
        return int(self.time_min.size)

    @property
    def raw_columns(self) -> dict[str, NDArray[np.float64]]:
        """Values by signal as they were sampled: those of `columns`, and those that are excluded."""
        excluded = {name: values for name, values in self.excluded.items() if name in self.columns}
        return self.columns | {
            name: np.where(np.isnan(values), self.columns[name], values) for name, values in excluded.items()
        }

    @property
    def zero(self) -> str | None:
        """Time from which the minutes are counted, as ISO 8601; None: unknown."""
        return format_utc(self.zero_ns) if self.zero_ns else None

    @property
    def stored_zero_ns(self) -> int:
        """Zero of the minutes in stored and published messages, whose times cannot be before 1970.

        This is `zero_ns` or, without clock time, as many days after 1970 as the record starts before its own zero.
        """
        earliest_min = float(self.time_min.min(initial=0.0))
        if self.zero_ns or not -LONGEST_MIN < earliest_min < 0:
            return self.zero_ns
        return ceil(-earliest_min / 1440) * 1440 * MINUTE_NS

    @property
    def run_starts(self) -> tuple[int, ...]:
        """First row of each run."""
        if self.runs is None:
            return (0,)
        return (0, *(int(row) + 1 for row in np.flatnonzero(np.diff(self.runs))))

    @property
    def span_min(self) -> float:
        """Minutes from the first row to the last, summed over the runs."""
        return sum(float(run.time_min[-1] - run.time_min[0]) for run in self.split_runs()) if self.rows else 0.0

    @property
    def continuous_min(self) -> NDArray[np.float64]:
        """Times that increase over all runs, shape (rows,): those of each run plus its `run_shifts_min`."""
        if self.runs is None:
            return self.time_min
        counts = np.diff([*self.run_starts, self.rows])
        return np.asarray(self.time_min + np.repeat(self.run_shifts_min, counts))

    @property
    def run_shifts_min(self) -> tuple[float, ...]:
        """Minutes that `continuous_min` adds to each run's times so that it follows the run before; 0 for the first."""
        runs = self.split_runs()
        steps = np.concatenate([np.diff(run.time_min) for run in runs])
        gap = GAP_ROWS * (float(np.median(steps)) if steps.size else 1.0)
        shifts = [0.0]
        for before, run in pairwise(runs):
            shifts.append(shifts[-1] + float(before.time_min[-1]) + gap - float(run.time_min[0]))
        return tuple(shifts)

    def split_runs(self) -> list["Record"]:
        """Split into records of one run each."""
        if self.runs is None:
            return [self]
        starts = self.run_starts
        return [
            replace(
                self,
                time_min=self.time_min[first:end],
                columns={signal: values[first:end] for signal, values in self.columns.items()},
                runs=None,
                excluded={signal: values[first:end] for signal, values in self.excluded.items()},
            )
            for first, end in pairwise((*starts, self.rows))
        ]

    @property
    def remarks(self) -> list[str]:
        """Remarks on the rows for people: several runs, samples that are left out, guesses about the file."""
        one = self.strays == 1
        strays = f"{self.strays} sample{'' if one else 's'} with a time or number that fits no other"
        left_out = [f"{strays} {'is' if one else 'are'} left out"] if self.strays else []
        read_as = [f"read as: {self.read_as}"] if self.read_as else []
        return [*filter(None, [self.describe_runs()]), *left_out, *read_as]

    def describe_runs(self) -> str:
        """Describe the runs on one line; empty for one run."""
        if self.runs is None:
            return ""
        spans = [f"{run.time_min[0]:g} to {run.time_min[-1]:g}" for run in self.split_runs()]
        more = f" and {len(spans) - MAX_SPANS} more" if len(spans) > MAX_SPANS else ""
        return (
            f"the plant's clock steps back, or the plant was restarted: {len(spans)} runs, "
            f"{', '.join(spans[:MAX_SPANS])} min{more}"
        )


def join_runs(runs: list[Record]) -> Record:
    """Join runs of the same signals into one record; other attributes are those of the first."""
    if len(runs) == 1:
        return runs[0]
    numbers = np.repeat(np.arange(1, len(runs) + 1), [run.rows for run in runs])
    columns = {signal: np.concatenate([run.columns[signal] for run in runs]) for signal in runs[0].columns}
    excluded = {
        signal: np.concatenate([run.excluded.get(signal, np.full(run.rows, np.nan)) for run in runs])
        for signal in dict.fromkeys(signal for run in runs for signal in run.excluded)
    }
    times = np.concatenate([run.time_min for run in runs])
    return replace(runs[0], time_min=times, columns=columns, runs=numbers, excluded=excluded)


EXCLUDED = "\0"
"""Begins the names of excluded values while rows are joined; no signal has it."""


def join_files(records: Sequence[Record]) -> Record:
    """Join records of files that follow each other.

    A file continues the last run of the file before it; if it starts before that run's end with other rows than those,
    it starts a new one.
    """
    first = records[0]
    if len(records) == 1:
        return first
    parts: list[Record] = []
    repeats: Counter[str] = Counter()
    for record in records:
        _check_alike(record, first)
        shift_min = (record.zero_ns - first.zero_ns) / MINUTE_NS
        for number, run in enumerate(record.split_runs()):
            part = replace(run, time_min=run.time_min + shift_min)
            if parts and not number:
                both = replace(join_runs([parts[-1], part]), runs=None)
                excluded = {EXCLUDED + name: values for name, values in both.excluded.items()}
                stay, columns, found = join_repeats(both.time_min, {**both.columns, **excluded})
                if (np.diff(both.time_min[stay]) > 0).all():
                    excluded = {name: columns.pop(EXCLUDED + name) for name in both.excluded}
                    part = replace(both, time_min=both.time_min[stay], columns=columns, excluded=excluded)
                    repeats += found
                    parts.pop()
            parts.append(part)
    strays = sum(record.strays for record in records)
    notes = dict.fromkeys(record.read_as for record in records if record.read_as)
    read_as = "; ".join([*notes, *(f"{text}: {count}" for text, count in repeats.items())])
    return replace(join_runs(parts), zero_ns=first.zero_ns, first_row=None, strays=strays, read_as=read_as)


def _check_alike(record: Record, first: Record) -> None:
    if record.columns.keys() != first.columns.keys():
        got, expected = ", ".join(record.columns), ", ".join(first.columns)
        raise InputError(f"{record.name}: expected the signals of {first.name}, {expected}, got {got}")
    if dict(record.units) != dict(first.units):
        raise InputError(f"{record.name}: expected the units of {first.name}, {first.units}, got {record.units}")
    if bool(record.zero_ns) != bool(first.zero_ns):
        raise InputError(f"{record.name}: expected {'' if first.zero_ns else 'no '}clock time, as {first.name} has")


DUPLICATES, MERGED = "duplicate rows left out", "rows merged into a later one of the same time, whose values count"


def join_repeats(
    times: NDArray[Any],
    columns: dict[str, NDArray[np.float64]],
    runs: NDArray[np.intp] | None = None,
    most: float = 1.0,
) -> tuple[NDArray[np.intp], dict[str, NDArray[np.float64]], Counter[str]]:
    """Leave out copies of earlier rows, and join different rows of one time: the last value of each signal counts.

    Copies stand below their originals, or are a block that was written again, as where exports overlap. A step back in
    time with other values starts another run, and stays.
    """
    every = np.arange(times.size)
    if (times[1:] > times[:-1]).all():
        return every, columns, Counter()
    run = np.zeros_like(every) if runs is None else runs
    order = np.lexsort((every, times, run))
    one, other = order[:-1], order[1:]
    is_copy, back = np.zeros((2, times.size), dtype=bool)
    is_copy[other] = (times[one] == times[other]) & (run[one] == run[other])
    for values in columns.values():
        is_copy[other] &= (values[one] == values[other]) | (np.isnan(values[one]) & np.isnan(values[other]))
    for rows in np.split(every, np.flatnonzero(np.diff(run)) + 1):
        back[rows] = times[rows] < np.fmax.accumulate(times[rows])
    block = np.cumsum(np.diff(back, prepend=False))
    block_is_copy = np.bincount(block[~is_copy], minlength=block[-1] + 1) == 0
    rest = np.flatnonzero(~(back & block_is_copy[block]))
    index = np.arange(rest.size)
    same = np.zeros(rest.size, dtype=bool)
    same[1:] = (times[rest][1:] == times[rest][:-1]) & (run[rest][1:] == run[rest][:-1])
    first, stays = np.maximum.accumulate(np.where(same, 0, index)), ~np.append(same[1:], False)
    joined, loses = {}, np.zeros(rest.size, dtype=bool)
    for name, values in columns.items():
        own = values[rest]
        loses[1:] |= same[1:] & (own[1:] != own[:-1]) & ~np.isnan(own[1:] + own[:-1])
        last = np.maximum.accumulate(np.where(np.isnan(own), 0, index))
        joined[name] = own[np.maximum(last, first)][stays]
    if np.count_nonzero(loses) > most * times.size:
        return every, columns, Counter()
    merged = int(np.count_nonzero(same & ~is_copy[rest]))
    copies = times.size - int(np.count_nonzero(stays)) - merged
    return rest[stays], joined, +Counter({DUPLICATES: copies, MERGED: merged})
