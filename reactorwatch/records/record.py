"""A record: times and the columns measured at them. Pure."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MINUTE_NS = 60_000_000_000

LARGEST_VALUE = 1e15
"""A value of at least this size measures nothing, and its square would soon be more than a number can hold."""

LONGEST_MIN = 2.0**62 / MINUTE_NS
"""From the zero of a record to any of its rows, 146 years: sums of times must still fit 64 bits of nanoseconds."""

UNITS = {"qc": "l/min", "C": "mol/l", "T": "K"}
"""The signals of the reactor and their units."""


def to_time_ns(minutes: float, zero_ns: int = 0) -> int:
    """A plant time as nanoseconds, to the nearest microsecond so that decimal minutes come back exactly."""
    return zero_ns + round(minutes * 60e6) * 1000


def to_minutes(time_ns: int, zero_ns: int = 0) -> float:
    """Nanoseconds as minutes since a zero.

    >>> to_minutes(to_time_ns(0.3))
    0.3
    """
    return (time_ns - zero_ns) / MINUTE_NS


@dataclass(frozen=True)
class Record:
    """A measured run.

    Attributes:
        time_min: shape (rows,), increasing.
        columns: by signal name, each of shape (rows,), in the signal's unit; NaN where nothing was measured. The
            input of row k is held over [t_k, t_k+1).
        name: where it came from, for messages.
        zero_ns: the time that its minutes count from, in nanoseconds since 1970-01-01 UTC; 0: not known.
        first_row: number of the first row in the file, as a text editor counts lines; None: the rows are no lines.
    """

    time_min: NDArray[np.float64]
    columns: dict[str, NDArray[np.float64]]
    name: str
    zero_ns: int = 0
    first_row: int | None = None

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
    def span_min(self) -> float:
        """From the first row to the last."""
        return float(self.time_min[-1] - self.time_min[0]) if self.rows else 0.0
