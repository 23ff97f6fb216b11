"""Record: times and the columns measured at them. Pure.

A record has several runs if the plant's clock stepped back or the plant was restarted. Rows keep the order of receipt,
and times increase within each run.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from math import ceil

import numpy as np
from numpy.typing import NDArray

MINUTE_NS = 60_000_000_000

NEVER_NS = 2**63 - 1
"""A time that does not come; the negative one is before all others."""

LARGEST_VALUE = 1e15
"""Values of at least this size are no measurements, and their squares would soon overflow."""

LONGEST_MIN = 2.0**62 / MINUTE_NS
"""Largest time of a row, 146 years: sums of times must still fit 64 bits of nanoseconds."""

SHIFT_NS = 1440 * MINUTE_NS
"""A day: times before 1970 are shifted by whole days to be stored and published."""

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
        return ceil(-earliest_min * MINUTE_NS / SHIFT_NS) * SHIFT_NS

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
