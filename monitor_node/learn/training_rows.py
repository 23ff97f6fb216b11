"""Rows of a training or an incident, from which a baseline is learned, and the screening of their residuals.

Disturbed intervals are found in blocks of residuals: the mean and spread of each block are compared with the median
over all blocks, in units of the median difference between neighbours (medians, after Hampel 1974, The influence curve
and its role in robust estimation, J. Amer. Statist. Assoc. 69; of differences, after von Neumann 1941). Neither moves
much while less than half of the blocks are disturbed. If more than a third is left out, the rest may not be the normal
state, and the training is refused.

Single outliers are left out too, at most one value in twenty: more of them are a property of the signal. (The residual
of a sensor with coarse steps, or of an analyser that holds its value, is nearly 0 in most rows, so its median deviation
does not describe the rows in which it moves.)

The residuals of a model that is wrong are larger after moves of the inputs than at rest: they are errors of the model,
not chance, and limits for chance do not hold there. The screening may even take them for outliers. A residual that is
white does not depend on moves before it, also in closed loop, where a controller moves the input because of earlier
residuals.
"""

from array import array
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from math import isfinite
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from reactorwatch.arrays import Array
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.stored_state import Memory

MOST_ROWS = 10_000
"""The newest rows used of a longer training; memory stays bounded."""


class RowArrays(NamedTuple):
    """Rows of one plant as arrays.

    Attributes:
        time_min: times in minutes, shape (n,).
        inputs: shape (n, inputs); NaN if missing.
        outputs: shape (n, outputs); NaN if missing or left out.
    """

    time_min: Array
    inputs: Array
    outputs: Array


class TrainingRows(Memory):
    """The newest rows of one plant, in two arrays. The object is its own state.

    Attributes:
        counts: number of values of each output.
        times: times of the rows in nanoseconds.
        numbers: inputs and outputs of the rows, one row after the other; NaN if missing.
        dropped: number of older rows that are not kept.
        keeps_all: True to use all rows of the training, however many they are.
    """

    counts: list[int]
    times: array = msgspec.field(default_factory=partial(array, "q"))  # type: ignore[type-arg] # none before Python 3.12
    numbers: array = msgspec.field(default_factory=partial(array, "d"))  # type: ignore[type-arg]
    dropped: int = 0
    keeps_all: bool = False

    def add(self, time_ns: int, inputs: Sequence[float], values: Sequence[float]) -> None:
        """Add a row."""
        if self.times and time_ns <= self.times[-1]:  # the publisher was restarted: so is the record
            del self.times[:], self.numbers[:]
            self.counts, self.dropped = [0] * len(values), 0
        if len(self.times) >= MOST_ROWS and not self.keeps_all:
            del self.times[0], self.numbers[: len(inputs) + len(values)]
            self.dropped += 1
        self.times.append(time_ns)
        self.numbers.extend((*inputs, *values))
        for index, value in enumerate(values):
            self.counts[index] += isfinite(value)

    @property
    def times_ns(self) -> list[int]:
        """Times of the rows."""
        return self.times.tolist()

    @property
    def arrays(self) -> RowArrays:
        """A copy of the rows as arrays."""
        inputs, outputs = np.hsplit(self._matrix(), [-len(self.counts)])
        return RowArrays(
            np.array(self.times_ns) / MINUTE_NS, np.ascontiguousarray(inputs), np.ascontiguousarray(outputs)
        )

    def values(self) -> list[list[float]]:
        """Inputs and outputs of each row."""
        rows: list[list[float]] = self._matrix().tolist()
        return rows

    def _matrix(self) -> Array:
        rows = len(self.times)
        return np.array(self.numbers).reshape(rows, len(self.numbers) // max(rows, 1))


Mask = NDArray[np.bool_]

SMALLEST_BLOCK = 20
"""Rows. In a training shorter than four such blocks only outliers are left out."""

OUTLIER = 6.0
"""Robust standard deviations beyond which a single value is left out."""

_TO_SD = 1.4826  # of the median absolute deviation, for normal values


class Screening(NamedTuple):
    """Result of screening n residuals.

    Attributes:
        usable: shape (n,), False where left out or missing.
        disturbed_intervals: disturbed rows, each (first, last), both included.
        shifts: deviation of each interval's mean, in robust standard deviations of single values.
        single: shape (n,), True for single values that are left out.
        left_out: shape (n,), True in disturbed rows and for outliers.
    """

    usable: Mask
    disturbed_intervals: list[tuple[int, int]]
    shifts: list[float]
    single: Mask
    left_out: Mask

    @property
    def outliers(self) -> int:
        """Number of single values left out."""
        return int(np.count_nonzero(self.single))

    @property
    def refused(self) -> bool:
        """True if too much is left out to trust the rest."""
        left_out = sum(last - first + 1 for first, last in self.disturbed_intervals)
        return left_out > 1.0 / 3.0 * self.usable.size


def screen_baseline(z: Array, smallest_sd: float = 0.0) -> Screening:
    """Find the usable part of a residual.

    Args:
        z: residuals in order of time, shape (n,); NaN if missing.
        smallest_sd: least standard deviation of values and of blocks' means; smaller deviations do not matter.
    """
    present = np.isfinite(z)
    if not present.any():
        return Screening(present, [], [], none := np.zeros(z.size, np.bool_), none)
    centre, sd = _centre_and_sd(z[present], smallest_sd)
    size = max(SMALLEST_BLOCK, z.size // 25)
    starts = np.arange(0, z.size - size + 1, size)
    disturbed = np.zeros(z.size, dtype=np.bool_)
    if starts.size >= 4 and sd > 0:
        edges = [*starts.tolist(), z.size]  # the last block has the remainder
        blocks = [z[a:b][present[a:b]] for a, b in pairwise(edges)]
        for index in _outlying_blocks(blocks, centre, sd, smallest_sd):
            disturbed[edges[index] : edges[index + 1]] = True
    disturbed_intervals = _intervals(disturbed)
    undisturbed = present & ~disturbed
    centre, sd = _centre_and_sd(z[undisturbed], smallest_sd)
    shifts = [float(np.nanmean(z[first : last + 1]) - centre) / max(sd, 1e-300) for first, last in disturbed_intervals]
    single = undisturbed & (np.abs(np.where(present, z, centre) - centre) > OUTLIER * sd) & (sd > 0)
    usable = undisturbed & ~single
    return Screening(usable, disturbed_intervals, shifts, single, present & ~usable)


def _centre_and_sd(z: Array, smallest_sd: float) -> tuple[float, float]:
    """Median, and robust standard deviation of the values."""
    centre = float(np.median(z))
    half, usual = np.quantile(np.abs(z - centre), (0.5, 0.95)).tolist()
    # 95 % of normal values are within 1.96 standard deviations
    return centre, max(_TO_SD * half, 1.0 / 1.96 * usual, smallest_sd)


def _outlying_blocks(blocks: list[Array], centre: float, sd: float, smallest_sd: float) -> list[int]:
    """Indices of the blocks whose mean or spread is an outlier."""
    filled = [index for index, block in enumerate(blocks) if block.size >= SMALLEST_BLOCK // 2]
    if len(filled) < 4:
        return []
    # Single outliers do not make a block one; without the clip they would.
    clipped = [np.clip(blocks[index], centre - OUTLIER * sd, centre + OUTLIER * sd) for index in filled]
    means = np.array([block.mean() for block in clipped])
    spreads = np.log(np.array([max(float(block.std()), smallest_sd, 1e-3 * sd) for block in clipped]))
    rows = float(np.median([block.size for block in clipped]))
    outlying = _is_far(means, max(sd / np.sqrt(rows), smallest_sd)) | _is_far(spreads, 1.0 / np.sqrt(2.0 * rows))
    return [filled[i] for i in np.flatnonzero(outlying)]


def _is_far(values: Array, smallest_sd: float) -> Mask:
    """Flags of values far from the median, in units of the differences of neighbours, at least those of white noise.

    A disturbance of two fifths of the blocks widens every measure of all blocks, but makes only two neighbours differ.
    """
    sd = _TO_SD * float(np.median(np.abs(np.diff(values)))) / np.sqrt(2.0)
    return np.asarray(np.abs(values - np.median(values)) > 5.0 * max(sd, smallest_sd))


def _intervals(disturbed: Mask) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], disturbed, [False]]).astype(np.int8)))
    return [(int(first), int(end) - 1) for first, end in zip(edges[::2], edges[1::2], strict=True)]


ROWS_AFTER = 5
"""Rows after a move in which the residual is compared."""


class AfterMoves(NamedTuple):
    """Residuals after the largest moves of the inputs.

    Attributes:
        size: their size in standard deviations, of the output where it is largest; 1 if it does not depend on moves.
        share: share of the rows that are after these moves.
    """

    size: float = 1.0
    share: float = 0.0

    def excess_rate(self, arl0: float) -> float:
        """Times as many false alarms as promised.

        Residuals that are larger by a factor s make an in-control run length A one of A^(1 / s^2).

        >>> AfterMoves().excess_rate(1e5), AfterMoves(2.0, 0.1).excess_rate(1e4)
        (1.0, 100.9)
        """
        return 1.0 - self.share + self.share * float(arl0 ** (1.0 - 1.0 / self.size**2))


def compare_after_moves(e: Array, inputs: Array) -> AfterMoves:
    """Compare residuals after moves of the inputs with the others.

    >>> rng = np.random.default_rng(0)
    >>> u = np.repeat(rng.normal(size=(100, 1)), 20, axis=0)
    >>> e = rng.normal(size=(2000, 1))
    >>> compare_after_moves(e, u).size
    1.0
    >>> for rows in (2, 3, 4):
    ...     e[rows:] += 2.0 * np.diff(u, axis=0)[: 1 - rows]
    >>> compare_after_moves(e, u).size > 1.2
    True

    Args:
        e: prewhitened residuals of all rows, shape (rows, outputs); NaN if missing, infinite for outliers.
        inputs: shape (rows, inputs).
    """
    moved = after_largest_moves(inputs)
    found, share = AfterMoves(), float(np.mean(moved))
    for column in np.abs(e.T):
        known = ~np.isnan(column)
        after, others = column[known & moved], column[known & ~moved]
        if min(len(after), len(others)) < 5:
            continue
        size = float(np.quantile(np.minimum(after, 10.0), 0.97)) / 2.17  # that of a standard normal variable
        if size > found.size and probability_of_larger(after, others) < 0.003 / e.shape[1]:
            found = AfterMoves(size, share)
    return found


def after_largest_moves(inputs: Array) -> NDArray[np.bool_]:
    """Flags of the rows after the largest moves of an input, about 0.1 of them, shape (rows,)."""
    known = [column[np.isfinite(column)] for column in inputs.T]
    spreads = np.array([np.std(column) if column.size else 0.0 for column in known])
    used = inputs[:, spreads > 0.0] / spreads[spreads > 0.0]
    if not used.size:
        return np.zeros(len(inputs), dtype=np.bool_)
    moves = np.nan_to_num(np.abs(np.diff(used, axis=0))).max(axis=1)
    before = np.concatenate([np.zeros(ROWS_AFTER + 1), moves])[: len(inputs) + ROWS_AFTER - 1]
    recent = np.lib.stride_tricks.sliding_window_view(before, ROWS_AFTER).max(axis=1)
    limit = np.quantile(recent, 0.9)
    moved = recent > limit
    return np.asarray(moved if moved.any() else (recent == limit) & (recent > 0.0))


def probability_of_larger(values: Array, others: Array) -> float:
    """Probability by chance that values rank so high among others (Mann & Whitney 1947, normal approximation).

    >>> round(probability_of_larger(np.arange(5.0, 15.0), np.arange(10.0)), 4)  # scipy.stats.mannwhitneyu
    0.0025
    """
    first, second, both = len(values), len(others), np.concatenate([values, others])
    _, index, counts = np.unique(both, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - 0.5 * (counts - 1))[index]
    total = first + second
    above = float(ranks[:first].sum()) - 0.5 * first * (first + 1) - 0.5 * first * second
    ties = float(np.sum(counts**3.0 - counts)) / (total * (total - 1.0))
    sd = np.sqrt(first * second / 12.0 * (total + 1.0 - ties))
    return float(ndtr(-(above - 0.5) / sd)) if sd > 0.0 else 1.0
