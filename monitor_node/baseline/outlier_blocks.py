"""Screen a training's residuals for disturbed blocks and outliers; learned from, these would give too wide limits.

The residual is cut into blocks of rows. The mean and spread of each block are compared with the median over all blocks,
in units of the median difference between neighbours (medians, after Hampel 1974, The influence curve and its role in
robust estimation, J. Amer. Statist. Assoc. 69; of differences, after von Neumann 1941). Neither moves much while less
than half of the blocks are disturbed. If more than a third is left out, the rest may not be the normal state, and the
training is refused.

Single outliers are left out too, at most one value in twenty: more of them are a property of the signal. (The residual
of a sensor with coarse steps, or of an analyser that holds its value, is nearly 0 in most rows, so its median deviation
does not describe the rows in which it moves.)
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from reactorwatch.arrays import Array

Mask = NDArray[np.bool_]

BLOCKS = 25
SMALLEST_BLOCK = 20
"""Rows. In a training shorter than four such blocks only outliers are left out."""

LARGEST_DEVIATION = 5.0
"""Robust standard deviations by which a block may differ from the median block."""

OUTLIER = 6.0
"""Robust standard deviations beyond which a single value is left out."""

MOST_LEFT_OUT = 1.0 / 3.0

USUAL_SHARE = 0.95
"""Least share of values that are no outliers."""

_TO_SD = 1.4826  # of the median absolute deviation, for normal values
_USUAL_TO_SD = 1.0 / 1.96  # of the absolute deviation that 95 % of normal values are within


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
        return left_out > MOST_LEFT_OUT * self.usable.size


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
    size = max(SMALLEST_BLOCK, z.size // BLOCKS)
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
    half, usual = np.quantile(np.abs(z - centre), (0.5, USUAL_SHARE)).tolist()
    return centre, max(_TO_SD * half, _USUAL_TO_SD * usual, smallest_sd)


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
    return np.asarray(np.abs(values - np.median(values)) > LARGEST_DEVIATION * max(sd, smallest_sd))


def _intervals(disturbed: Mask) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], disturbed, [False]]).astype(np.int8)))
    return [(int(first), int(end) - 1) for first, end in zip(edges[::2], edges[1::2], strict=True)]
