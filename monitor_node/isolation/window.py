"""The rows that a cause is looked for in, and what the filter makes of them if nothing is wrong.

Every hypothesis is compared on the same rows, so what counts is settled here. The filter follows values that are far
off from the second one on, as the monitor's own does. A value is an outlier, and counts as missing whatever the cause,
if it stands out, alone or with its neighbour, from those before and after, which agree with each other. So is the
newest one, if it is far off and the one before was not: nothing confirms it yet.

Where rows are missing and the input behind them is another, it is not known when it changed (see
`kalman.input_uncertainty`): no cause may be found in what a lost row leaves.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, isfinite, nan
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from monitor_node.ingest.sampling import missing_rows
from reactorwatch.arrays import Array
from reactorwatch.kalman.ekf import LONGEST_GAP_MIN, Filter, FilterState
from reactorwatch.kalman.filter_record import LONGEST_ROW_MIN
from reactorwatch.kalman.input_uncertainty import InputUncertainty

Row: TypeAlias = tuple[float, float, Sequence[float]]
"""Time in minutes, input, outputs; NaN where missing."""

BURN_IN_ROWS = 20
"""Rows at the start in which the filter still finds its state: nothing is said to set in there."""

GATE = 6.0
"""A value so many standard deviations off has to be confirmed."""

_OF_THREE = 1.5**0.5  # standard deviation of a value less the mean of its neighbours, for white noise

GAP_PERIODS = 5.0
"""Rows that are so many usual periods apart have a gap between them, in which nobody knows what the input was."""


MOST_PIECES = 6_000
"""Pieces of two integration steps that the way through a window has at most, beside one for each row: 600 rows that are
a minute apart. A filter takes some microseconds for each, so of rows that are farther apart fewer are looked at."""


@dataclass(frozen=True, eq=False)
class Window:
    """Rows without a long gap, and the filter's run over them.

    Attributes:
        time_min: shape (rows,).
        inputs: shape (rows, 1).
        measured: shape (rows, n_y); NaN where missing or an outlier.
        residual: what the filter was off by, shape (rows, n_y); NaN where missing or an outlier.
        used: whether a value corrected the filter, shape (rows, n_y).
        states: of the filter after each row.
        first_onset: the first row at which something may set in; at least 1.
        uncertainty: ways on which the input changed at an unknown time; None: there are none.
    """

    time_min: Array
    inputs: Array
    measured: Array
    residual: Array
    used: NDArray[np.bool_]
    states: list[FilterState]
    first_onset: int
    uncertainty: InputUncertainty | None = None

    @property
    def earliest_min(self) -> float:
        """Earliest time of an onset."""
        return float(self.time_min[self.first_onset])

    @property
    def span_min(self) -> float:
        """How long the time is in which something may set in."""
        return float(self.time_min[-1] - self.time_min[self.first_onset - 1])

    @property
    def x(self) -> Array:
        """Of the filter after each row, shape (rows, n_x)."""
        return np.array([state.x for state in self.states])

    @property
    def covariance(self) -> Array:
        """Of the filter's state after each row, shape (rows, n_x, n_x)."""
        x = len(self.states[0].x)
        return np.array([state.P for state in self.states]).reshape(len(self.states), x, x)


def window_of(rows: Sequence[Row], kalman: Filter, not_before_min: float = -inf) -> Window | None:
    """The newest rows without a gap; None if there are none in which something may set in.

    Args:
        rows: oldest first; where the input is missing it is taken to be as it was.
        kalman: of the plant without a fault; begins anew.
        not_before_min: nothing was wrong before.
    """
    kept = _since_gap(_running_on(rows))
    times, inputs = np.array([row[0] for row in kept]), np.array([[row[1]] for row in kept])
    uncertainty = _doubt(times, inputs)
    first_onset = max(BURN_IN_ROWS, int(np.searchsorted(times, not_before_min)))
    if first_onset >= times.size:
        return None
    measured = np.array([row[2] for row in kept], dtype=float)
    n_y = measured.shape[1]
    residual, off = np.full(measured.shape, nan), np.zeros(measured.shape, dtype=bool)
    used = np.zeros(measured.shape, dtype=bool)
    states: list[FilterState] = []
    sd: list[tuple[float, ...]] = []
    accept = [False] * n_y
    kalman.restart()
    for place, (time_min, value, outputs) in enumerate(kept):
        other = (
            ((value,), uncertainty.change_times_min(place))
            if uncertainty is not None and uncertainty.rows[place]
            else None
        )
        found = kalman.update(time_min, (value,), outputs, gate=GATE, accept=accept, uncertainty=other)
        far = [abs(size) > GATE * sd for size, sd in zip(found.residual, found.sd, strict=True)]
        off[place] = far
        used[place] = [
            isfinite(size) and (follow or not out)
            for size, follow, out in zip(found.residual, accept, far, strict=True)
        ]
        residual[place] = found.residual
        sd.append(found.sd)
        accept = far
        states.append(kalman.state)
    # A filter that soon follows a step leaves its first rows standing alone; a plant that moves a lot, any row.
    outlier = _standing_out(residual, np.array(sd)) & _standing_out(measured, np.array(sd))
    outlier[-1] = off[-1] & ~off[-2]
    return Window(
        times,
        inputs,
        np.where(outlier, np.nan, measured),
        np.where(outlier, np.nan, residual),
        used,
        states,
        first_onset,
        uncertainty,
    )


def newest_rows(rows: Sequence[Row], least: int = 0) -> Sequence[Row]:
    """The newest rows between which there are no more than `MOST_PIECES` pieces.

    Args:
        rows: oldest first.
        least: number of rows that are kept in any case.
    """
    apart = np.diff([row[0] for row in rows])
    pieces = np.where((apart > 0.0) & (apart <= LONGEST_GAP_MIN), np.ceil(apart / LONGEST_ROW_MIN) - 1.0, 0.0)
    before = int(np.searchsorted(np.cumsum(pieces[::-1]), MOST_PIECES, side="right")) + 1
    return rows[-max(before, least, 1) :]


def _doubt(time_min: Array, inputs: Array) -> InputUncertainty | None:
    """Ways to rows behind missing rows whose input is another than that of the row before; None: there are none."""
    if time_min.size < 2:
        return None
    spacing, changed = np.diff(time_min), inputs[1:, 0] != inputs[:-1, 0]
    period, missing = float(np.median(spacing)), np.zeros(time_min.size, dtype=np.intp)
    for place in np.flatnonzero(changed).tolist():
        missing[place + 1] = missing_rows(float(spacing[place]) / period)
    return InputUncertainty.for_missing_rows(time_min, inputs, missing) if missing.any() else None


def _standing_out(values: Array, sd: Array) -> NDArray[np.bool_]:
    """Which, alone or two in a row, stand out from those before and after them, shape (rows, n_y)."""
    found = np.zeros(values.shape, dtype=bool)
    for column, sizes, out in zip(values.T, sd.T, found.T, strict=True):
        known = np.flatnonzero(np.isfinite(column))
        for count in (1, 2):
            before, after = column[known[: -count - 1]], column[known[count + 1 :]]
            between = [known[place : known.size - count - 1 + place] for place in range(1, count + 1)]
            usual, apart = 0.5 * (before + after), np.abs(after - before)
            least = [np.maximum(GATE * _OF_THREE * sizes[now], apart) for now in between]
            far = [np.abs(column[now] - usual) > size for now, size in zip(between, least, strict=True)]
            for now in between:
                out[now[np.logical_and.reduce(far)]] = True
    return found


def _running_on(rows: Sequence[Row]) -> list[Row]:
    """The newest rows whose times increase, every input known, from one on in which something is measured."""
    kept: list[Row] = []
    flow = nan
    for row in rows:
        if kept and not row[0] > kept[-1][0]:
            kept = []
        flow = row[1] if isfinite(row[1]) else flow
        if isfinite(flow) and (kept or any(isfinite(value) for value in row[2])):
            kept.append((row[0], flow, row[2]))
    return kept


def _since_gap(rows: list[Row]) -> list[Row]:
    """The rows since the last gap."""
    if len(rows) < 2:
        return rows
    apart = np.diff([row[0] for row in rows])
    gaps = np.flatnonzero(apart > min(GAP_PERIODS * float(np.median(apart)), LONGEST_GAP_MIN))
    return rows[int(gaps[-1]) + 1 :] if gaps.size else rows
