"""A record: times and the columns measured at them. Pure.

Where the plant's clock steps back, or the plant was restarted, a record has several runs. Rows keep the order of their
receipt, and times increase within each run.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from math import ceil

import numpy as np
from numpy.typing import NDArray

MINUTE_NS = 60_000_000_000

LARGEST_VALUE = 1e15
"""A value of at least this size measures nothing, and its square would soon be more than a number can hold."""

LONGEST_MIN = 2.0**62 / MINUTE_NS
"""From the zero of a record to any of its rows, 146 years: sums of times must still fit 64 bits of nanoseconds."""

SHIFT_NS = 1440 * MINUTE_NS
"""A day: times before 1970 are stored and published later by whole days."""

GAP_ROWS = 20
"""Sampling periods that `Record.continuous_min` leaves between two runs: after so long a gap no row is predicted from
the rows before it."""

MOST_SPANS = 5
"""Runs whose times are named to people."""

UNITS = {"qc": "l/min", "C": "mol/l", "T": "K"}
"""The signals of the reactor, which is the process where none is named, and their units."""


def to_time_ns(minutes: float, zero_ns: int = 0) -> int:
    """A plant time as nanoseconds, to the nearest microsecond so that decimal minutes come back exactly."""
    return zero_ns + round(minutes * 60e6) * 1000


def to_minutes(time_ns: int, zero_ns: int = 0) -> float:
    """Nanoseconds as minutes since a zero.

    >>> to_minutes(to_time_ns(0.3))
    0.3
    """
    return (time_ns - zero_ns) / MINUTE_NS


def clock_time(time_ns: int) -> str | None:
    """A clock time as in ISO 8601, in UTC; None if it is beyond the years that can be written.

    >>> clock_time(1_772_352_000_250_000_000)
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
    """A measured run, or several one after the other.

    Attributes:
        time_min: shape (rows,), increasing within each run.
        columns: by signal name, each of shape (rows,), in the signal's unit; NaN where nothing was measured. The
            input of row k is held over [t_k, t_k+1).
        name: where it came from, for messages.
        zero_ns: the time that its minutes count from, in nanoseconds since 1970-01-01 UTC; 0: not known.
        first_row: number of the first row in the file, as a text editor counts lines; None: the rows are no lines.
        runs: the run that each row is of, shape (rows,), counted from 1; None: there is one.
        units: of the signals, by name; a signal whose unit is not known has none.
        strays: samples that are in no row, because their number or time fits neither those before nor those after.
    """

    time_min: NDArray[np.float64]
    columns: dict[str, NDArray[np.float64]]
    name: str
    zero_ns: int = 0
    first_row: int | None = None
    runs: NDArray[np.intp] | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    strays: int = 0

    def __post_init__(self) -> None:
        for signal, values in self.columns.items():
            if values.shape != self.time_min.shape:
                raise ValueError(
                    f"column {signal!r} must have as many rows as the times, {self.time_min.size}, got {values.size}"
                )

    @property
    def rows(self) -> int:
        """How many rows it has."""
        return int(self.time_min.size)

    @property
    def zero(self) -> str | None:
        """The clock time that its minutes count from, as in ISO 8601; None: not known."""
        return clock_time(self.zero_ns) if self.zero_ns else None

    @property
    def stored_zero_ns(self) -> int:
        """The zero of its minutes where it is stored or published, which no time can be before 1970.

        It is `zero_ns`; without clock time it is as many days after 1970 as the record starts before its own zero.
        """
        earliest_min = float(self.time_min.min(initial=0.0))
        if self.zero_ns or not -LONGEST_MIN < earliest_min < 0:
            return self.zero_ns
        return ceil(-earliest_min * MINUTE_NS / SHIFT_NS) * SHIFT_NS

    @property
    def run_starts(self) -> tuple[int, ...]:
        """The first row of each run."""
        if self.runs is None:
            return (0,)
        return (0, *(int(row) + 1 for row in np.flatnonzero(np.diff(self.runs))))

    @property
    def span_min(self) -> float:
        """From the first row to the last, summed over the runs."""
        return sum(float(run.time_min[-1] - run.time_min[0]) for run in self.each_run()) if self.rows else 0.0

    @property
    def continuous_min(self) -> NDArray[np.float64]:
        """Times that increase over all runs, shape (rows,): of each run, its own and its `run_shifts_min`."""
        if self.runs is None:
            return self.time_min
        counts = np.diff([*self.run_starts, self.rows])
        return np.asarray(self.time_min + np.repeat(self.run_shifts_min, counts))

    @property
    def run_shifts_min(self) -> tuple[float, ...]:
        """Of each run, what `continuous_min` adds to its times so that it follows the run before; 0 for the first."""
        runs = self.each_run()
        steps = np.concatenate([np.diff(run.time_min) for run in runs])
        gap = GAP_ROWS * (float(np.median(steps)) if steps.size else 1.0)
        shifts = [0.0]
        for before, run in pairwise(runs):
            shifts.append(shifts[-1] + float(before.time_min[-1]) + gap - float(run.time_min[0]))
        return tuple(shifts)

    def each_run(self) -> list["Record"]:
        """Its runs, each as a record of its own."""
        if self.runs is None:
            return [self]
        starts = self.run_starts
        return [
            replace(
                self,
                time_min=self.time_min[first:end],
                columns={signal: values[first:end] for signal, values in self.columns.items()},
                runs=None,
            )
            for first, end in pairwise((*starts, self.rows))
        ]

    @property
    def remarks(self) -> list[str]:
        """What people have to know of its rows: several runs, samples that are left out."""
        one = self.strays == 1
        strays = f"{self.strays} sample{'' if one else 's'} with a time or number that fits no other"
        left_out = [f"{strays} {'is' if one else 'are'} left out"] if self.strays else []
        return [*filter(None, [self.describe_runs()]), *left_out]

    def describe_runs(self) -> str:
        """Its runs for people, on one line; empty where there is one."""
        if self.runs is None:
            return ""
        spans = [f"{run.time_min[0]:g} to {run.time_min[-1]:g}" for run in self.each_run()]
        more = f" and {len(spans) - MOST_SPANS} more" if len(spans) > MOST_SPANS else ""
        return (
            f"the plant's clock steps back, or the plant was restarted: {len(spans)} runs, "
            f"{', '.join(spans[:MOST_SPANS])} min{more}"
        )


def join_runs(runs: list[Record]) -> Record:
    """One record of several runs of the same signals; all that is not in a row is that of the first."""
    if len(runs) == 1:
        return runs[0]
    numbers = np.repeat(np.arange(1, len(runs) + 1), [run.rows for run in runs])
    columns = {signal: np.concatenate([run.columns[signal] for run in runs]) for signal in runs[0].columns}
    times = np.concatenate([run.time_min for run in runs])
    return replace(runs[0], time_min=times, columns=columns, runs=numbers)
