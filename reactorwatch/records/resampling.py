"""Resample a record to rows of one period: means of fast signals, held values of those reported by exception. Pure.

Row k of a run stands for the time t_k = t_0 + k P, and its input is held until t_(k+1). So the mean of an output is
over the time around its row, from t_k - P/2 to t_k + P/2, and that of an input from t_k to t_(k+1). Both are integrals
over time: a value of an output stands for half of the way to its neighbours, one of an input until the next one. A ramp
so stays the ramp that it was, many values in a short time weigh no more than one, regular rows of this period stay as
they are, and a signal that is slower than the rows keeps its nearest value (an input, its last one) between.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError, UnfitRecordError, describe_unknown
from reactorwatch.records.file_format import INTERPOLATED, LAST, MEAN, SECONDS, SPARSE, ResampleRule
from reactorwatch.records.record import Record, join_runs

LONGEST_HOLD = 5.0
"""A value is held for at most five times the spacing that nine in ten of a signal's values keep: of values at random
(exponential) spacings one in 100,000 lasts longer, of regular ones five rows. Rows that are further apart are a gap."""

SLOW = 1.5
"""A signal is slower than the period if its median spacing is this many periods: halfway from one to every second
row."""

_LEAST_COVERED = 0.75
"""Share of a period that values must stand for, if it is to have a mean: the middle of what is left is off by an eighth
of a period at most. More than half of it must be measurements."""

_MOST_ROWS = 50_000_000
"""Rows of a resampled record: 400 MB a signal. More are asked for by a period in the wrong unit."""

_LEAST_MOVES = 20
"""Moves from which a report by exception is recognised: 20 moves of sampled noise look so in 2 % of cases."""

_SMALL_MOVES = 0.05
"""Share of moves below half of the median move up to which a signal is reported by exception. A deadband leaves none,
and normal noise has 26 %: P(|z| < 0.674 / 2)."""

DIGITS = 6
"""Decimals of times in periods: stamps are rounded to a digit, and one that is a row's is to be exactly the row's."""


class _Series(NamedTuple):
    """Values of one signal in one run, each of shape (values,); excluded ones are no measurements."""

    time_min: Array
    values: Array
    excluded: NDArray[np.bool_]


class SignalPlan(NamedTuple):
    """Resampling of one signal.

    Attributes:
        method: one of the methods.
        is_input: True if a value acts until the next one.
        is_slow: True if it has fewer values than there are rows.
        spacing: median spacing of its values, in periods.
        longest: longest time for which a value stands, in periods; infinite for a signal that is silent until it moves.
    """

    method: str
    is_input: bool
    is_slow: bool
    spacing: float
    longest: float


def resample(record: Record, rule: ResampleRule, roles: Mapping[str, str]) -> Record:
    """Resample a record to rows of one period, each run by itself from its first row.

    Args:
        record: the record; NaN: not measured.
        rule: period and methods; signals that it does not name have the method of their kind.
        roles: role by signal; a signal without one is an output.

    Returns:
        The record; `read_as` states period, methods and gaps. Rows in gaps, and those without any value, are left out.

    Raises:
        InputError: the rule names a signal that is not there, no signal has two values or no row one, or the period is
            too short.
    """
    for name in rule.methods:
        if name not in record.columns:
            raise InputError(f"{record.name}: --resample: {describe_unknown('signal', name, record.columns)}")
    runs = [(run, {name: _series(run, name) for name in record.columns}) for run in record.split_runs()]
    series = {name: [own[name] for _, own in runs] for name in record.columns}
    spacings = {name: np.concatenate([np.diff(own.time_min) for own in parts]) for name, parts in series.items()}
    by_exception = {name for name, parts in series.items() if is_by_exception([part[:2] for part in parts])}
    period_min, reason = (
        (rule.period_s / 60.0, "")
        if rule.period_s is not None
        else find_period_min(record.name, spacings, by_exception)
    )
    has_faster = any(values.size and np.median(values) <= SLOW * period_min for values in spacings.values())
    plans = {
        name: _plan(
            rule,
            name,
            roles.get(name, "output"),
            values / period_min,
            by_exception=name in by_exception,
            has_faster=has_faster,
        )
        for name, values in spacings.items()
    }
    stamps = [np.unique(np.concatenate([item.time_min for item in own.values()])) for _, own in runs]
    gap = _longest(np.concatenate([np.diff(times) for times in stamps]) / period_min)
    resampled, gaps = [], 0
    for (run, own), times in zip(runs, stamps, strict=True):
        if times.size:
            rows, found = _find_rows(record.name, times, period_min, gap)
            made = _resample_run(run, own, plans, float(times[0]), period_min, rows)
            resampled += [made] if made.rows else []
            gaps += found
    if not resampled:
        raise UnfitRecordError(f"{record.name}: --resample: no row has a value; state another period")
    read_as = ", ".join(filter(None, [record.read_as, _state(period_min, reason, plans, gaps)]))
    return replace(join_runs(resampled), read_as=read_as)


def _series(run: Record, name: str) -> _Series:
    values = run.raw_columns[name]
    known = np.flatnonzero(~np.isnan(values))
    return _Series(run.time_min[known], values[known], np.isnan(run.columns[name][known]))


def is_by_exception(runs: Sequence[tuple[Array, Array]]) -> bool:
    """True if a signal is reported when it has moved: at irregular times, and by no small moves.

    Values that came because the longest time between two reports had passed do not count.

    Args:
        runs: times and values of each run, each of shape (values,).
    """
    spacing = np.concatenate([np.diff(times) for times, _ in runs])
    moves = np.abs(np.concatenate([np.diff(values) for _, values in runs]))
    if spacing.size < _LEAST_MOVES or _is_regular(spacing):
        return False
    own = moves[spacing < 0.95 * np.quantile(spacing, 0.99)]
    return own.size >= _LEAST_MOVES and float(np.mean(own < 0.5 * np.median(own))) <= _SMALL_MOVES


def _is_regular(spacing: Array) -> bool:
    """True if nine in ten spacings are the median one to a fifth: a sampler's, perhaps with lost values."""
    return spacing.size > 0 and float(np.mean(np.abs(spacing / np.median(spacing) - 1) < 0.2)) > 0.9


def find_period_min(name: str, spacings: Mapping[str, Array], by_exception: set[str]) -> tuple[float, str]:
    """Median spacing of the fastest signal that is sampled, or of all signals if all are reported by exception.

    Args:
        name: name of the record, for the error.
        spacings: minutes between a signal's values, by signal.
        by_exception: signals that are reported by exception.

    Returns:
        Minutes, to three digits of their unit; and the reason, for people.

    Raises:
        InputError: no signal has two values.
    """
    medians = {signal: float(np.median(values)) for signal, values in spacings.items() if values.size}
    if not medians:
        raise UnfitRecordError(f"{name}: --resample auto: expected a signal with two values, got none; state a period")
    sampled = {signal: value for signal, value in medians.items() if signal not in by_exception} or medians
    fastest = min(sampled, key=sampled.__getitem__)
    amount, unit = _in_unit(sampled[fastest])
    return float(f"{amount:.3g}") * SECONDS[unit] / 60.0, f" (median spacing of {fastest})"


def _in_unit(minutes: float) -> tuple[float, str]:
    """A duration in the largest of d, h, min, s and ms in which it is at least 1."""
    seconds = minutes * 60.0
    unit = next((unit for unit in ("d", "h", "min", "s") if seconds >= SECONDS[unit] * (1 - 1e-9)), "ms")
    return seconds / SECONDS[unit], unit


def _plan(
    rule: ResampleRule, name: str, role: str, spacing: Array, *, by_exception: bool, has_faster: bool
) -> SignalPlan:
    """Resampling of a signal from its role and its spacings in periods; `has_faster`: another signal is not slow."""
    median = float(np.median(spacing)) if spacing.size else np.inf
    is_slow, is_code = median > SLOW, role in ("mode", "label")
    is_sparse = is_slow and has_faster and role == "output"
    of_kind = LAST if by_exception or role == "setpoint" else SPARSE if is_sparse else MEAN
    method = rule.methods.get(name) or (LAST if is_code else rule.method) or of_kind
    lasts = by_exception or (role != "output" and not _is_regular(spacing))
    longest = np.inf if lasts else _longest(spacing)
    return SignalPlan(method, role != "output", is_slow, median if spacing.size else 1.0, longest)


def _longest(spacing: Array) -> float:
    return LONGEST_HOLD * max(1.0, float(np.quantile(spacing, 0.9)) if spacing.size else 0.0)


def _find_rows(name: str, times: Array, period_min: float, gap: float) -> tuple[NDArray[np.int64], int]:
    """Numbers of the rows of a run that are in no gap, in order, and the number of gaps."""
    index = (times - times[0]) / period_min
    ends = np.flatnonzero(np.diff(index) > gap)
    edges = [0, *(int(end) + 1 for end in ends), times.size]
    nearest = np.floor(np.round(index, DIGITS) + 0.5)
    spans = [(float(nearest[first]), float(nearest[end - 1])) for first, end in pairwise(edges)]
    if sum(last - first + 1 for first, last in spans) > _MOST_ROWS:
        amount, unit = _in_unit(period_min)
        cure = "state a longer one"
        raise InputError(f"{name}: --resample {amount:g} {unit} makes more than {_MOST_ROWS:,} rows; {cure}")
    rows = [np.arange(int(first), int(last) + 1, dtype=np.int64) for first, last in spans]
    return np.unique(np.concatenate(rows)), int(ends.size)


def _resample_run(
    run: Record,
    series: Mapping[str, _Series],
    plans: Mapping[str, SignalPlan],
    start_min: float,
    period_min: float,
    rows: NDArray[np.int64],
) -> Record:
    """Rows of one run, without those in which nothing is measured."""
    measured, excluded = dict[str, Array](), dict[str, Array]()
    for name, (times, values, is_excluded) in series.items():
        index, plan = np.round((times - start_min) / period_min, DIGITS), plans[name]
        measured[name] = values_in_rows(index, np.where(is_excluded, np.nan, values), rows, plan)
        if name in run.excluded:
            excluded[name] = values_in_rows(index, np.where(is_excluded, values, np.nan), rows, plan)
    stay = ~np.all(np.isnan([*measured.values(), *excluded.values()]), axis=0)
    return replace(
        run,
        time_min=start_min + rows[stay] * period_min,
        columns={name: values[stay] for name, values in measured.items()},
        excluded={name: values[stay] for name, values in excluded.items()},
        first_row=None,
    )


def _mean(index: Array, values: Array, rows: NDArray[np.int64], plan: SignalPlan) -> Array:
    """Mean over the time of each row; see the text of this module."""
    if not index.size:
        return np.full(rows.size, np.nan)
    end = max(1.0, plan.spacing) if plan.is_input else plan.spacing  # what a value before a gap stands for
    steps = np.diff(index)
    ahead = np.append(np.where(steps > plan.longest, end, steps), end if plan.longest < np.inf else np.inf)
    if plan.is_input:
        offset, starts, ends = 0.0, index, index + ahead
    else:
        offset, starts, ends = 0.5, index - np.append(end, ahead[:-1]) / 2, index + ahead / 2
    ends = np.minimum(ends, rows[-1] + 1.0)
    cuts = np.unique(np.concatenate([starts, ends, rows - offset, rows + (1 - offset)]))
    middle, length = (cuts[1:] + cuts[:-1]) / 2, np.diff(cuts)
    value = np.searchsorted(starts, middle, side="right") - 1
    row = np.minimum(np.searchsorted(rows, np.floor(middle + offset)), rows.size - 1)
    stands = (value >= 0) & (middle < ends[value]) & (rows[row] == np.floor(middle + offset))
    row, length, value = row[stands], length[stands], values[value[stands]]
    is_known = ~np.isnan(value)
    covered = np.bincount(row, length, rows.size)
    known = np.bincount(row[is_known], length[is_known], rows.size)
    sums = np.bincount(row[is_known], (length * value)[is_known], rows.size)
    has_mean = (covered >= _LEAST_COVERED) & (known > covered / 2)
    return np.where(has_mean, sums / np.where(has_mean, known, 1.0), np.nan)


def _last(index: Array, values: Array, rows: NDArray[np.int64], plan: SignalPlan) -> Array:
    """Last value up to each row."""
    at = np.searchsorted(index, rows, side="right") - 1
    age = rows - np.concatenate([index, [-np.inf]])[at]
    return np.where(age <= plan.longest, np.concatenate([values, [np.nan]])[at], np.nan)


def _sparse(index: Array, values: Array, rows: NDArray[np.int64], _plan: SignalPlan) -> Array:
    """Each value in its nearest row, the last one where there are several."""
    at = np.searchsorted(index, rows + 0.5, side="left") - 1
    age = rows - np.concatenate([index, [-np.inf]])[at]
    return np.where(age <= 0.5, np.concatenate([values, [np.nan]])[at], np.nan)


def _interpolate(index: Array, values: Array, rows: NDArray[np.int64], plan: SignalPlan) -> Array:
    """The line between the values before and after each row."""
    if not index.size:
        return np.full(rows.size, np.nan)
    before = np.concatenate([[-np.inf], index])[np.searchsorted(index, rows, side="right")]
    after = np.append(index, np.inf)[np.searchsorted(index, rows, side="left")]
    return np.where(after - before <= plan.longest, np.interp(rows, index, values), np.nan)


_METHODS = {MEAN: _mean, LAST: _last, SPARSE: _sparse, INTERPOLATED: _interpolate}


def values_in_rows(index: Array, values: Array, rows: NDArray[np.int64], plan: SignalPlan) -> Array:
    """Values of a signal in rows of one period.

    Args:
        index: times of its values in periods after row 0, increasing, shape (values,).
        values: the values, shape (values,); NaN: no measurement.
        rows: numbers of the rows, increasing, shape (rows,).
        plan: resampling of the signal.

    Returns:
        Shape (rows,); NaN where it has none.
    """
    return _METHODS[plan.method](index, values, rows, plan)


def _state(period_min: float, reason: str, plans: Mapping[str, SignalPlan], gaps: int) -> str:
    """Statement for people: period, methods and gaps; of many signals of one method their number."""
    amount, unit = _in_unit(period_min)
    groups: dict[str, list[str]] = {}
    for name, plan in plans.items():
        between = {
            MEAN: "held between" if plan.is_input else "the nearest value between",
            LAST: "held between",
            SPARSE: "empty between",
        }
        has_note = plan.is_slow and plan.method in between
        groups.setdefault(plan.method + (f" ({between[plan.method]})" if has_note else ""), []).append(name)
    parts = [
        part
        for kind, names in groups.items()
        for part in ([f"{name} {kind}" for name in names] if len(names) <= 4 else [f"{len(names)} signals {kind}"])
    ]
    left = [f"{gaps} gap{'' if gaps == 1 else 's'} left"] if gaps else []
    return ", ".join([f"resampled to {amount:.6g} {unit}{reason}: {', '.join(parts)}", *left])
