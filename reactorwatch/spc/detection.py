"""Smallest deviations that charts detect in time, from what a deviation of unit size does to their signals.

A deviation moves the mean of the prewhitened residuals to a m(k) in row k, with a its size: residuals are linear in it.
An average of weight lambda is a first-order autoregression about its own smoothed mean, in units of its standard
deviation, and crosses its limit L in a row in which it was within it before with the probability

    h(u) = P(A' > u | A and all before it <= u),      u = L - |a M(k)|,

A and A' being neighbours of that autoregression, as if M had been there for long. The chance to miss is the product of
1 - h over the rows, and no more than the chance that the largest |a M| alone is missed, which counts where M rises
faster than the average forgets. Where an alarm takes several points, h is the rate of that rule. Of several charts the
one that misses least counts, as all see the same noise.
"""

from collections.abc import Sequence
from functools import cache
from math import sqrt
from typing import NamedTuple

import numpy as np
from scipy import linalg, special

from reactorwatch.arrays import Array
from reactorwatch.spc.averages import ewma
from reactorwatch.spc.false_alarm_budget import return_level
from reactorwatch.spc.run_length import false_alarm_rates

POWER = 0.9
"""Share of the cases in which a deviation is seen in time."""

LOWEST = -4.0
"""Lowest distance from the limit, in standard deviations: a point there is out almost surely."""

HAZARDS = 1e-15, 1.0 - 1e-9
"""Bounds of the probability of a crossing, whose logarithms are taken."""


class Detector(NamedTuple):
    """A chart as a moving average with a limit.

    Attributes:
        signals: indices of the signals that it looks at.
        matrix: map that makes them independent with unit variance, shape (p, p).
        weight: weight of the newest row.
        level: limit of the average's length, in its standard deviations.
        rule: points that raise the alarm, and the number of points among which they count.
    """

    signals: tuple[int, ...]
    matrix: Array
    weight: float
    level: float
    rule: tuple[int, int] = (1, 1)


def error_factor(e: Array, detectors: Sequence[Detector], arl0: float) -> float:
    """Times by which limits have to be wider where residuals are errors of a model, by their peaks.

    At least 1, and so much that none of the rows given would have raised an alarm.

    Args:
        e: prewhitened residuals of held-out rows, shape (rows, signals); NaN where there is none.
        detectors: the charts.
        arl0: run length of each chart without a fault, in rows.
    """
    single = np.abs(np.nan_to_num(e)) / -special.ndtri(0.5 / arl0)  # as a check for spikes sees them
    largest = single.max(axis=1)
    for chart in detectors:
        values = np.nan_to_num(e[:, list(chart.signals)]) @ chart.matrix.T
        average = np.linalg.norm(ewma(values, chart.weight), axis=1)
        count, window = chart.rule
        recent = np.lib.stride_tricks.sliding_window_view(np.concatenate([np.zeros(window - 1), average]), window)
        violated = np.sort(recent, axis=1)[:, -count]
        np.maximum(largest, violated / (chart.level * sqrt(chart.weight / (2.0 - chart.weight))), out=largest)
    # the tails of errors are those of exponential values rather than normal ones: so not their squares
    return max(return_level(np.sqrt(largest), arl0) ** 2, float(largest.max(initial=1.0)))


class _Path(NamedTuple):
    """Sizes of an average's mean under a unit deviation, with the rows that each stands for.

    Attributes:
        mean: shape (deviations, onsets, nodes).
        rows: number of rows within each horizon, shape (horizons, nodes).
    """

    mean: Array
    rows: Array


def smallest_sizes(paths: Array, detectors: Sequence[Detector], horizons: Sequence[float], ramp_rows: float) -> Array:
    """Smallest sizes that are seen within some horizons, shape (deviations, horizons); infinite: none is.

    Args:
        paths: mean of each signal by row after the onset of a unit step, shape (deviations, onsets, rows, signals).
        detectors: the charts.
        horizons: numbers of rows.
        ramp_rows: rows in which a ramp reaches the unit size; 0: the deviations are steps.
    """
    shape = (paths.shape[0], len(horizons))
    if not detectors or not paths.size:
        return np.full(shape, np.inf)
    charts = [(item, _chart_path(paths, item, horizons, ramp_rows)) for item in detectors]
    largest = max(float(path.mean.max(initial=0.0)) for _, path in charts)
    if not largest:
        return np.full(shape, np.inf)
    log_size = np.full(shape, -np.log(largest))
    low, high = log_size - 5.0, log_size + 20.0
    at_low, at_high = np.full((2, *shape), np.nan)
    for _ in range(11):  # bisections of 25 units of the logarithm, before the last interpolation
        middle = 0.5 * (low + high)
        log_missed = np.min([_miss_log_probability(chart, path, np.exp(middle)) for chart, path in charts], axis=0)
        missed = np.clip(np.exp(log_missed).mean(axis=2), 1e-300, 1.0 - 1e-16)
        excess = np.log(np.log(1.0 - POWER) / np.log(missed))  # nearly straight, positive where it is not seen
        seen = excess <= 0.0
        low, high = np.where(seen, low, middle), np.where(seen, middle, high)
        at_low, at_high = np.where(seen, at_low, excess), np.where(seen, excess, at_high)
    found = low + (high - low) * at_low / (at_low - at_high)
    return np.where(high >= log_size + 19.9, np.inf, np.exp(np.where(np.isfinite(found), found, high)))


def _chart_path(paths: Array, chart: Detector, horizons: Sequence[float], ramp_rows: float) -> _Path:
    """Path of a chart's average: in its rows, and beyond them by those of their later half."""
    late_nodes = 8  # that stand for all rows beyond the path
    signals = paths[..., list(chart.signals)] @ chart.matrix.T
    rows = signals.shape[2]
    later = signals[:, :, rows // 2 :]
    if ramp_rows:
        signals = np.cumsum(signals, axis=2) / ramp_rows
    unit = sqrt(chart.weight / (2.0 - chart.weight))
    smoothed = ewma(signals, chart.weight) / unit
    nodes = np.unique(np.geomspace(1.0, rows, 40).round().astype(int))
    ends = np.concatenate([0.5 * (nodes[1:] + nodes[:-1] + 1), [rows + 1.0]])
    starts = np.concatenate([[1.0], ends[:-1]])
    counts = [np.clip(np.minimum(ends, horizon + 1.0) - starts, 0.0, None) for horizon in horizons]
    beyond = np.array([max(horizon - rows, 0.0) for horizon in horizons])
    if ramp_rows:
        times = rows + np.outer(beyond, (np.arange(late_nodes) + 0.5) / late_nodes)
        slope = later.mean(axis=2) / (ramp_rows * unit)
        end = signals[:, :, -1] / unit
        late = end[:, :, None] + slope[:, :, None] * (times.ravel()[None, None, :, None] - rows)
        late_size = np.linalg.norm(late, axis=3)
        late_rows = np.zeros((len(horizons), times.size))
        for index, count in enumerate(beyond):
            late_rows[index, index * late_nodes : (index + 1) * late_nodes] = count / late_nodes
    else:
        shares = (np.arange(late_nodes) + 0.5) / late_nodes
        sizes = np.linalg.norm(smoothed[:, :, rows // 2 :], axis=3)
        late_size = np.moveaxis(np.quantile(sizes, shares, axis=2), 0, 2)
        late_rows = np.repeat(beyond[:, None] / late_nodes, late_nodes, axis=1)
    mean = np.concatenate([np.linalg.norm(smoothed[:, :, nodes - 1], axis=3), late_size], axis=2)
    return _Path(mean, np.hstack([np.array(counts), late_rows]))


def _miss_log_probability(chart: Detector, path: _Path, sizes: Array) -> Array:
    """Logarithm of the probability of a miss, shape (deviations, horizons, onsets).

    Args:
        chart: the chart.
        path: path of its average.
        sizes: sizes of the deviations, shape (deviations, horizons).
    """
    moved = sizes[:, :, None, None] * path.mean[:, None]
    distance = chart.level - np.sqrt(moved**2 + (len(chart.signals) - 1.0))
    grid, log_within = _log_within(chart.weight, *chart.rule)
    values = -np.exp(np.interp(distance, grid, np.log(-log_within)))
    log_missed = np.asarray(np.einsum("dhon,hn->dho", values, path.rows))
    if chart.rule == (1, 1):
        nearest = np.where(path.rows[:, None, :] > 0.0, distance, np.inf).min(axis=3)
        log_missed = np.minimum(log_missed, special.log_ndtr(nearest))
    return log_missed


@cache
def _log_within(weight: float, count: int, window: int) -> tuple[Array, Array]:
    """Grid of distances u from the limit, and the logarithm of the probability to stay within it for one row."""
    grid = np.linspace(LOWEST, 9.0, 53)
    if count > 1:
        rates = false_alarm_rates(count, window, np.clip(special.ndtr(-grid), 1e-12, 1.0))
        return grid, np.log1p(-np.clip(rates, *HAZARDS))
    kept, spread = 1.0 - weight, sqrt(weight * (2.0 - weight))
    nodes, weights = np.polynomial.legendre.leggauss(200)
    before = LOWEST - 3.0 + 0.5 * (grid[:, None] - LOWEST + 3.0) * (nodes + 1.0)
    scaled = 0.5 * (grid[:, None] - LOWEST + 3.0) * weights
    density = np.exp(-0.5 * before**2) / np.sqrt(2.0 * np.pi) * scaled
    crossing = np.sum(density * special.ndtr(-(grid[:, None] - kept * before) / spread), axis=1)
    log_within = np.log1p(-np.clip(crossing / np.maximum(density.sum(axis=1), 1e-300), *HAZARDS))
    if weight < 1.0:
        near = grid <= 4.0  # further off a crossing does not depend on rows before the last
        log_within[near] = np.log(_remaining_shares(grid[near], kept, spread))
    return grid, log_within


def _remaining_shares(limits: Array, kept: float, spread: float) -> Array:
    """Share of a stationary autoregression that stays below each limit for one row, having stayed for long.

    The largest eigenvalue of the transitions below the limit, which reversibility makes symmetric.
    """
    cell = min(0.1, 0.5 * spread)
    lowest = LOWEST - 2.0
    shares = []
    for limit in limits.tolist():
        at = np.arange(limit - 0.5 * cell, lowest, -cell)
        ends = at[:, None] - kept * at[None, :]
        transitions = np.exp(-0.5 * (ends / spread) ** 2 - 0.25 * (at[None, :] ** 2 - at[:, None] ** 2))
        transitions *= cell / (spread * sqrt(2.0 * np.pi))
        last = len(at) - 1
        shares.append(float(linalg.eigh(transitions, eigvals_only=True, subset_by_index=(last, last))[0]))
    return np.clip(shares, 1.0 - HAZARDS[1], 1.0 - HAZARDS[0])
