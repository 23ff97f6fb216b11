"""Resample a record to rows of one period: means of fast signals, held values of those reported by exception. Pure."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, describe_unknown
from reactorwatch.records.file_format import INTERPOLATED, LAST, MEAN, SECONDS, SPARSE, ResampleRule
from reactorwatch.records.record import Record, join_runs

LONGEST_HOLD = 5.0
"""A value is held for at most five times the spacing that nine in ten of a signal's values keep: of values at random
(exponential) spacings one in 100,000 lasts longer, of regular ones five rows. Rows that are further apart are a gap."""

_SLOW = 1.5
"""A signal is slower than the period if its median spacing is this many periods: halfway from one to every second
row."""

_MOST_ROWS = 50_000_000
"""Rows of a resampled record: 400 MB a signal. More are asked for by a period in the wrong unit."""

_LEAST_MOVES = 20
"""Moves from which a report by exception is recognised: 20 moves of sampled noise look so in 2 % of cases."""

_SMALL_MOVES = 0.05
"""Share of moves below half of the median move up to which a signal is reported by exception. A deadband leaves none,
and normal noise has 26 %: P(|z| < 0.674 / 2)."""


class _Series(NamedTuple):
    """Values of one signal in one run, each of shape (values,); excluded ones are no measurements."""

    time_min: Array
    values: Array
    excluded: NDArray[np.bool_]


class _Grid(NamedTuple):
    """Rows of a run: row k is at `start_min + k * period_min`; `rows` are those outside gaps, in order."""

    start_min: float
    period_min: float
    rows: NDArray[np.int64]


def resample(record: Record, rule: ResampleRule, roles: Mapping[str, str]) -> Record:
    """Resample a record to rows of one period, each run by itself.

    The rows of a run are whole periods after its first row. A mean is over the period around its row; that of an input
    with several values in a period is over the period that begins there, for which a model holds it. A held value is
    the last one up to its row.

    Args:
        record: the record; NaN: not measured.
        rule: period and methods; signals that it does not name have the method of their kind.
        roles: role by signal; a signal without one is an output.

    Returns:
        The record; `read_as` states period, methods, held rows and gaps.

    Raises:
        InputError: the rule names a signal that is not there, no signal has two values, or the period is too short.
    """
    for name in rule.methods:
        if name not in record.columns:
            raise InputError(f"{record.name}: --resample: {describe_unknown('signal', name, record.columns)}")
    runs = [(run, {name: _series(run, name) for name in record.columns}) for run in record.split_runs()]
    spacings = {name: np.concatenate([np.diff(series[name].time_min) for _, series in runs]) for name in record.columns}
    by_exception = {
        name: is_by_exception([(series[name].time_min, series[name].values) for _, series in runs])
        for name in record.columns
    }
    period_min = find_period_min(record.name, spacings, by_exception) if rule.period_s is None else rule.period_s / 60.0
    slow = {name: not values.size or np.median(values) > _SLOW * period_min for name, values in spacings.items()}
    methods = {
        name: rule.methods.get(name)
        or rule.method
        or _choose_method(roles.get(name, "output"), is_slow=slow[name], by_exception=by_exception[name])
        for name in record.columns
    }
    stamps = [np.unique(np.concatenate([item.time_min for item in series.values()])) for _, series in runs]
    gap_min = _longest_hold(np.concatenate([np.diff(item) for item in stamps]), period_min)
    resampled, held, gaps = [], 0, 0
    for (run, series), times in zip(runs, stamps, strict=True):
        if not times.size:
            continue
        grid, found = _make_grid(record.name, times, period_min, gap_min)
        gaps += found
        columns, excluded = {}, {}
        for name, own in series.items():
            is_fast = spacings[name].size and np.median(spacings[name]) <= period_min / 2
            lead = 0.5 if roles.get(name) == "input" and is_fast else 0.0
            longest_min = gap_min if by_exception[name] or slow[name] else _longest_hold(spacings[name], period_min)
            values, bad, own_held = _resample(own, grid, methods[name], longest_min, lead)
            columns[name] = np.where(bad, np.nan, values)
            if name in record.excluded:
                excluded[name] = np.where(bad, values, np.nan)
            held += own_held if methods[name] == MEAN else 0
        time_min = grid.start_min + grid.rows * period_min
        resampled.append(
            replace(run, time_min=time_min, columns=columns, excluded=excluded, first_row=None),
        )
    joined = join_runs(resampled)
    read_as = ", ".join(filter(None, [record.read_as, _describe(period_min, methods, held, gaps)]))
    return replace(joined, read_as=read_as)


def _series(run: Record, name: str) -> _Series:
    values = run.raw_columns[name]
    known = np.flatnonzero(~np.isnan(values))
    return _Series(run.time_min[known], values[known], np.isnan(run.columns[name][known]))


def is_by_exception(runs: list[tuple[Array, Array]]) -> bool:
    """True if a signal is reported when it has moved: at irregular times, and by no small moves.

    Values that came because the longest time between two reports had passed do not count.

    Args:
        runs: times and values of each run, each of shape (values,).
    """
    spacing = np.concatenate([np.diff(times) for times, _ in runs])
    moves = np.abs(np.concatenate([np.diff(values) for _, values in runs]))
    if spacing.size < _LEAST_MOVES:
        return False
    if np.mean(np.abs(spacing - np.median(spacing)) < 0.2 * np.median(spacing)) > 0.9:
        return False
    own = moves[spacing < 0.95 * np.quantile(spacing, 0.99)]
    return own.size >= _LEAST_MOVES and float(np.mean(own < 0.5 * np.median(own))) <= _SMALL_MOVES


def find_period_min(name: str, spacings: Mapping[str, Array], by_exception: Mapping[str, bool]) -> float:
    """Median spacing of the fastest signal that is sampled, or of all signals if all are reported by exception.

    Args:
        name: name of the record, for the error.
        spacings: minutes between a signal's values, by signal.
        by_exception: True for a signal that is reported by exception, by signal.

    Returns:
        Minutes, to three digits of their unit.

    Raises:
        InputError: no signal has two values.
    """
    medians = {signal: float(np.median(values)) for signal, values in spacings.items() if values.size}
    sampled = [value for signal, value in medians.items() if not by_exception[signal]]
    if not medians:
        raise InputError(f"{name}: --resample auto: expected a signal with two values, got none; state a period")
    amount, unit = _in_unit(min(sampled or medians.values()))
    return float(f"{amount:.3g}") * SECONDS[unit] / 60.0


def _in_unit(minutes: float) -> tuple[float, str]:
    """A duration in the largest of d, h, min, s and ms in which it is at least 1."""
    seconds = minutes * 60.0
    unit = next((unit for unit in ("d", "h", "min", "s") if seconds >= SECONDS[unit] * (1 - 1e-9)), "ms")
    return seconds / SECONDS[unit], unit


def _choose_method(role: str, *, is_slow: bool, by_exception: bool) -> str:
    """Method of a signal: the mean of a fast one, the last value of what is held, else each value in its row."""
    if role in ("mode", "label"):
        return LAST
    if not is_slow:
        return LAST if by_exception else MEAN
    return LAST if by_exception or role in ("input", "setpoint") else SPARSE


def _longest_hold(spacing: Array, period_min: float) -> float:
    usual = float(np.quantile(spacing, 0.9)) if spacing.size else 0.0
    return LONGEST_HOLD * max(period_min, usual)


def _make_grid(name: str, times: Array, period_min: float, gap_min: float) -> tuple[_Grid, int]:
    """Rows of a run from its times, and the number of gaps."""
    index = (times - times[0]) / period_min
    ends = np.flatnonzero(np.diff(times) > gap_min)
    edges = [0, *(int(end) + 1 for end in ends), times.size]
    spans = [(_nearest(index[first]), _nearest(index[end - 1])) for first, end in pairwise(edges)]
    if sum(int(last - first) + 1 for first, last in spans) > _MOST_ROWS:
        amount, unit = _in_unit(period_min)
        raise InputError(
            f"{name}: --resample {amount:g} {unit} makes more than {_MOST_ROWS:,} rows; state a longer one"
        )
    rows = np.unique(np.concatenate([np.arange(first, last + 1) for first, last in spans]))
    return _Grid(float(times[0]), period_min, rows), int(ends.size)


_ROUNDING = 1e-6
"""Share of a period within which a time counts as that of a row: stamps are rounded to a digit."""


def _nearest(index: Array) -> NDArray[np.int64]:
    return np.floor(index + 0.5 + _ROUNDING).astype(np.int64)


def _resample(
    own: _Series, grid: _Grid, method: str, longest_min: float, lead: float
) -> tuple[Array, NDArray[np.bool_], int]:
    """Values of a signal in the rows, True where a value is excluded, and the number of rows with a held value.

    Args:
        own: the signal.
        grid: the rows.
        method: one of the methods.
        longest_min: time for which a value is held, in minutes.
        lead: share of a period by which the interval of a mean is moved on.
    """
    values, bad = np.full(grid.rows.size, np.nan), np.zeros(grid.rows.size, dtype=bool)
    if not own.values.size:
        return values, bad, 0
    index = (own.time_min - grid.start_min) / grid.period_min
    if method == INTERPOLATED:
        good = ~own.excluded
        if not good.any():
            return values, bad, 0
        at = np.searchsorted(index[good], grid.rows - _ROUNDING)
        padded = np.concatenate([[-np.inf], index[good], [np.inf]])
        near = (padded[at + 1] - padded[at]) * grid.period_min <= longest_min
        near |= np.abs(padded[at + 1] - grid.rows) <= _ROUNDING
        return np.where(near, np.interp(grid.rows, index[good], own.values[good]), np.nan), bad, 0
    cell = np.ceil(index - _ROUNDING).astype(np.int64) if method == LAST else _nearest(index - lead)
    order = np.argsort(cell, kind="stable")  # times increase, so this keeps the last value of a row last
    cell, known, excluded = cell[order], own.values[order], own.excluded[order]
    at = np.searchsorted(cell, grid.rows, side="right") - 1
    age = np.where(at >= 0, grid.rows - cell[at], np.iinfo(np.int64).max)
    shown = age == 0 if method == SPARSE else age * grid.period_min <= longest_min
    values[shown], bad[shown] = known[at[shown]], excluded[at[shown]]
    if method != LAST:
        first = cell[0]
        counts = np.bincount(cell - first, ~excluded)
        sums = np.bincount(cell - first, np.where(excluded, 0.0, known))
        with np.errstate(invalid="ignore", divide="ignore"):
            means = sums / counts
        fresh = (age == 0) & (counts[np.minimum(np.maximum(grid.rows - first, 0), counts.size - 1)] > 0)
        values[fresh], bad[fresh] = means[grid.rows[fresh] - first], False
    return values, bad, int(np.count_nonzero(shown & (age > 0)))


def _describe(period_min: float, methods: Mapping[str, str], held: int, gaps: int) -> str:
    """What was done, for people; of many signals of one method their number."""
    amount, unit = _in_unit(period_min)
    by_method = {
        kind: [name for name, own in methods.items() if own == kind] for kind in dict.fromkeys(methods.values())
    }
    shown = 4  # names of a method that a line of a terminal has room for
    parts = [
        part
        for kind, names in by_method.items()
        for part in ([f"{name} {kind}" for name in names] if len(names) <= shown else [f"{len(names)} signals {kind}"])
    ]
    counts = [f"{held} means without a value held from the row before"] if held else []
    counts += [f"{gaps} gap{'' if gaps == 1 else 's'} left"] if gaps else []
    return ", ".join([f"resampled to {amount:.6g} {unit}: {', '.join(parts)}", *counts])
