"""The rows in which a cause is sought, and the run of a filter without a fault over them.

All hypotheses are compared on the same rows, so rows and outliers are decided here. The filter ignores a value that is
far off unless the one before was, too; so does the monitor's own. A value is an outlier, and counts as missing for
every cause, if it stands out, alone or with its neighbour, from those before and after, which agree with each other. So
is the newest one if it is far off and the one before was not: nothing confirms it yet.

Where rows are missing and the input after them differs, the time of the change is unknown (see
`kalman.batch.InputUncertainty`): no cause may be inferred from a lost row.
"""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from math import isfinite, nan
from typing import NamedTuple, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from monitor_node.ingest.alignment import missing_rows
from reactorwatch.arrays import Array
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.batch import GATE, LONGEST_GAP_MIN, LONGEST_ROW_MIN, FilterRecord, InputUncertainty
from reactorwatch.kalman.ekf import Filter, FilterState
from reactorwatch.stored_state import Memory

Row: TypeAlias = tuple[float, Sequence[float], Sequence[float]]
"""Time in minutes, inputs, outputs; missing values are NaN."""

BURN_IN_ROWS = 20
"""Number of rows at the start in which the filter settles: no onset is sought there."""

MOST_PIECES = 6_000
"""Largest number of additional pieces of two integration steps in the intervals of a window: 600 rows that are a minute
apart. A filter takes some microseconds for each piece, so fewer rows are used if they are farther apart."""


class RecentRows(Memory):
    """The newest rows in one array of doubles: most of the memory of a plant. The object is its own state.

    Attributes:
        n_inputs: number of inputs.
        columns: numbers of a row: time in minutes, inputs, outputs.
        most: number of rows that are kept.
        numbers: the rows one after the other, oldest first; up to 64 more than are kept.
    """

    n_inputs: int
    columns: int
    most: int
    numbers: array = msgspec.field(default_factory=partial(array, "d"))  # type: ignore[type-arg] # none before Python 3.12

    def __len__(self) -> int:
        return min(len(self.numbers) // self.columns, self.most)

    def add(self, row: Sequence[float]) -> bool:
        """Add a row: time in minutes, inputs, outputs.

        Returns:
            False if the row is not later than the newest, and all rows before it were removed.
        """
        is_later = not self.numbers or row[0] > self.numbers[-self.columns]
        if not is_later:
            del self.numbers[:]
        self.numbers.extend(row)
        # the oldest are removed together, since that moves all others
        if len(self.numbers) > (self.most + 64) * self.columns:
            self.keep(self.most)
        return is_later

    def keep(self, most: int) -> None:
        """Keep this many rows from now on, and of those so far."""
        del self.numbers[: -len(self) * self.columns]
        self.most = most
        del self.numbers[: -most * self.columns]

    def rows(self) -> list[Row]:
        """The rows, oldest first."""
        size, inputs = self.columns, 1 + self.n_inputs
        values = self.numbers[-len(self) * size :].tolist()
        parts = (values[begin : begin + size] for begin in range(0, len(self) * size, size))
        return [(part[0], part[1:inputs], part[inputs:]) for part in parts]


@dataclass(frozen=True, eq=False, kw_only=True)
class Window(Run):
    """Rows without a long gap, in which outliers are missing, and the run of the filter over them.

    Attributes:
        residual: innovations, shape (rows, n_y); NaN where missing or an outlier.
        used: mask of values that corrected the filter, shape (rows, n_y).
        x: filtered state, shape (rows, n_x).
        covariance: covariance of the filtered state, shape (rows, n_x, n_x).
    """

    residual: Array
    used: NDArray[np.bool_]
    x: Array
    covariance: Array

    @property
    def earliest_min(self) -> float:
        """Earliest time of an onset."""
        return float(self.time_min[BURN_IN_ROWS])

    @property
    def onset_span_min(self) -> float:
        """Length of the time in which an onset is sought."""
        return float(self.time_min[-1] - self.time_min[BURN_IN_ROWS - 1])


def window_of(rows: Sequence[Row], kalman: Filter) -> Window | None:
    """Make a window of the newest rows without a gap; None if no onset can be sought in them.

    Args:
        rows: rows, oldest first; a missing input is taken to be the last known one.
        kalman: filter of the plant without a fault; it is restarted.
    """
    kept = rows_since_break(rows)
    times, inputs = np.array([row[0] for row in kept]), np.array([row[1] for row in kept], dtype=float)
    if times.size <= BURN_IN_ROWS + 1:  # an onset lies before the newest row
        return None
    measured, missing = np.array([row[2] for row in kept], dtype=float), _count_missing(times, inputs)
    run = _run_filter(kalman, times, inputs, measured, missing)
    # A filter that soon follows a step leaves only its first rows far off; one of a plant that moves a lot, any row.
    outlier = _stands_out(run.residual, run.sd) & _stands_out(measured, run.sd)
    outlier[-1] = run.far[-1] & ~run.far[-2]
    return Window(
        times,
        inputs,
        np.where(outlier, np.nan, measured),
        missing=missing,
        residual=np.where(outlier, np.nan, run.residual),
        used=run.used,
        x=run.x,
        covariance=run.covariance,
    )


class _FilterRun(NamedTuple):
    residual: Array
    sd: Array
    far: NDArray[np.bool_]
    used: NDArray[np.bool_]
    x: Array
    covariance: Array


def _run_filter(
    kalman: Filter, times: Array, inputs: Array, measured: Array, missing: NDArray[np.intp] | None
) -> _FilterRun:
    """Filter the rows; a value beyond the gate corrects the filter only if the one before was beyond it, too.

    Rows are filtered in chunks, and one by one only where values are beyond the gate.
    """
    uncertainty = None if missing is None else InputUncertainty.for_missing_rows(times, inputs, missing)
    (rows, n_y), n_x = measured.shape, len(kalman.model.states)
    nothing, no_flags = np.full((rows, n_y), nan), np.zeros((rows, n_y), dtype=bool)
    states = np.zeros((rows, n_x)), np.zeros((rows, n_x, n_x))
    run = _FilterRun(nothing, nothing.copy(), no_flags, no_flags.copy(), *states)
    kalman.restart()
    row, chunk, accept = 0, 16, np.zeros(n_y, dtype=bool)
    while row < rows:
        part = slice(row, row + 1 if accept.any() else min(row + chunk, rows))
        later = None if uncertainty is None else uncertainty.select(part)
        if accept.any():
            changes = [] if later is None else later.changes(0)
            values = inputs[row].tolist(), measured[row].tolist()
            one = kalman.update(times[row], *values, gate=GATE, accept=accept.tolist(), changes=changes)
            run.residual[row], run.sd[row] = one.residual, one.sd
            run.x[row], run.covariance[row] = kalman.state.x, np.reshape(kalman.state.P, (n_x, n_x))
        else:
            record = FilterRecord(times[part], inputs[part], measured[part], GATE, None, later)
            result = kalman.run(record, kalman.state if row else None)
            run.residual[part], run.sd[part] = result.residual, result.sd
            run.x[part], run.covariance[part] = result.x, result.P
            for index in (row + np.flatnonzero(np.isnan(result.x).any(axis=1))).tolist():  # the filter has not started
                before = max(index - 1, 0)
                run.x[index], run.covariance[index] = (run.x[before], run.covariance[before]) if index else (0.0, 0.0)
        run.far[part] = np.abs(run.residual[part]) > GATE * run.sd[part]
        run.used[part] = np.isfinite(run.residual[part]) & (~run.far[part] | accept)
        beyond = np.flatnonzero(run.far[part].any(axis=1))
        last = row + int(beyond[0]) if beyond.size else part.stop - 1
        if last + 1 < part.stop:
            belief = tuple(run.x[last].tolist()), tuple(run.covariance[last].ravel().tolist())
            kalman.state = FilterState(float(times[last]), tuple(inputs[last].tolist()), *belief)
        row, accept, chunk = last + 1, run.far[last], 16 if beyond.size else 2 * chunk
    return run


def newest_rows(rows: Sequence[Row], least: int = 0) -> Sequence[Row]:
    """Select the newest rows whose intervals have at most `MOST_PIECES` additional pieces."""
    apart = np.diff([row[0] for row in rows])
    pieces = np.where((apart > 0.0) & (apart <= LONGEST_GAP_MIN), np.ceil(apart / LONGEST_ROW_MIN) - 1.0, 0.0)
    before = int(np.searchsorted(np.cumsum(pieces[::-1]), MOST_PIECES, side="right")) + 1
    return rows[-max(before, least, 1) :]


def _count_missing(time_min: Array, inputs: Array) -> NDArray[np.intp] | None:
    """Number of missing rows before each row whose input differs from the row before; None if none are missing."""
    if time_min.size < 2:
        return None
    spacing, changed = np.diff(time_min), (inputs[1:] != inputs[:-1]).any(axis=1)
    period, missing = float(np.median(spacing)), np.zeros(time_min.size, dtype=np.intp)
    for row in np.flatnonzero(changed).tolist():
        missing[row + 1] = missing_rows(float(spacing[row]) / period)
    return missing if missing.any() else None


def _stands_out(values: Array, sd: Array) -> NDArray[np.bool_]:
    """Mask of values that, alone or two in a row, stand out from those before and after them, shape (rows, n_y)."""
    result = np.zeros(values.shape, dtype=bool)
    for column, sizes, out in zip(values.T, sd.T, result.T, strict=True):
        finite = np.flatnonzero(np.isfinite(column))
        for count in (1, 2):
            before, after = column[finite[: -count - 1]], column[finite[count + 1 :]]
            between = [finite[index : finite.size - count - 1 + index] for index in range(1, count + 1)]
            usual, apart = 0.5 * (before + after), np.abs(after - before)
            # 1.5 ** 0.5: standard deviation of a value minus the mean of its neighbours, white noise
            least = [np.maximum(GATE * (1.5**0.5) * sizes[now], apart) for now in between]
            far = [np.abs(column[now] - usual) > size for now, size in zip(between, least, strict=True)]
            for now in between:
                out[now[np.logical_and.reduce(far)]] = True
    return result


def _running_on(rows: Sequence[Row]) -> list[Row]:
    """Select the newest rows with increasing times, inputs filled, from the first row with a measurement on."""
    kept: list[Row] = []
    inputs: Sequence[float] = (nan,) * (len(rows[0][1]) if rows else 0)
    for row in rows:
        if kept and not row[0] > kept[-1][0]:
            kept = []
        inputs = [now if isfinite(now) else last for now, last in zip(row[1], inputs, strict=True)]
        if all(map(isfinite, inputs)) and (kept or any(isfinite(value) for value in row[2])):
            kept.append((row[0], inputs, row[2]))
    return kept


def is_break(rows: Sequence[Row], time_min: float) -> bool:
    """True if a row of this time does not follow the others: after a long gap, or after the clock was set back."""
    return len(rows) > 1 and len(rows_since_break([*rows, (time_min, *rows[-1][1:])])) == 1


def rows_since_break(rows: Sequence[Row]) -> list[Row]:
    """Select the rows since the last long gap or clock step, inputs filled."""
    kept = _running_on(rows)
    if len(kept) < 2:
        return kept
    apart = np.diff([row[0] for row in kept])
    # in an interval of more than five median periods the input is unknown
    gaps = np.flatnonzero(apart > min(5.0 * float(np.median(apart)), LONGEST_GAP_MIN))
    return kept[int(gaps[-1]) + 1 :] if gaps.size else kept
