"""Which part of a training is fit to learn limits from: one stretch that was itself disturbed would teach wide limits.

The residual is cut into blocks of some rows each, and each block is compared with the median of all blocks, in its
mean and in its spread; by how much blocks may differ is told by the median of the differences between neighbours
(medians, after Hampel 1974, The influence curve and its role in robust estimation, J. Amer. Statist. Assoc. 69; of
differences, after von Neumann 1941). Neither moves by much while less than half of the blocks are disturbed. When more
than a third has to be left out, what remains is no longer surely the normal state, and the training is refused.

Single outliers are left out too: at most one value in twenty, for what more values do is how the signal is. (The
residual of a sensor with coarse steps, or of an analyser that holds its value, is nearly 0 in most rows, so its median
deviation says nothing of the rows in which it moves.)
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BLOCKS = 25
SMALLEST_BLOCK = 20
"""Rows. A training shorter than four such blocks is taken as it is, but for its outliers."""

LARGEST_DEVIATION = 5.0
"""Robust standard deviations by which a block may differ from the median block."""

OUTLIER = 6.0
"""Robust standard deviations beyond which a single value is left out."""

MOST_LEFT_OUT = 1.0 / 3.0

USUAL_SHARE = 0.95
"""Of the values that are no outliers, at least."""

_TO_SD = 1.4826  # of the median absolute deviation, for normal values
_USUAL_TO_SD = 1.0 / 1.96  # of the absolute deviation that 95 % of normal values are within


class Undisturbed(NamedTuple):
    """What can be learned from.

    Attributes:
        usable: shape (n,), False where it is left out or not known.
        stretches: of disturbed rows, each (first, last), both included.
        shifts: how far the mean of each stretch is from the usual, in robust standard deviations of single values.
        outliers: number of single values left out.
    """

    usable: Mask
    stretches: list[tuple[int, int]]
    shifts: list[float]
    outliers: int

    @property
    def refused(self) -> bool:
        """Whether so much had to be left out that what remains cannot be trusted."""
        left_out = sum(last - first + 1 for first, last in self.stretches)
        return left_out > MOST_LEFT_OUT * self.usable.size


def undisturbed(z: Array, smallest_sd: float = 0.0) -> Undisturbed:
    """The part of a residual that can be learned from.

    Args:
        z: shape (n,), in order of time; NaN where it is not known.
        smallest_sd: standard deviations of values, and of the means of blocks, are taken as at least this: what is
            smaller is of no interest.
    """
    known = np.isfinite(z)
    if not known.any():
        return Undisturbed(known, [], [], 0)
    centre, sd = _centre_and_sd(z[known], smallest_sd)
    size = max(SMALLEST_BLOCK, z.size // BLOCKS)
    starts = np.arange(0, z.size - size + 1, size)
    disturbed = np.zeros(z.size, dtype=np.bool_)
    if starts.size >= 4 and sd > 0:
        edges = [*starts.tolist(), z.size]  # the last block takes the rest
        blocks = [z[a:b][known[a:b]] for a, b in pairwise(edges)]
        for index in _strange(blocks, centre, sd, smallest_sd):
            disturbed[edges[index] : edges[index + 1]] = True
    stretches = _stretches(disturbed)
    rest = known & ~disturbed
    centre, sd = _centre_and_sd(z[rest], smallest_sd)
    shifts = [float(np.nanmean(z[first : last + 1]) - centre) / max(sd, 1e-300) for first, last in stretches]
    single = rest & (np.abs(np.where(known, z, centre) - centre) > OUTLIER * sd) & (sd > 0)
    return Undisturbed(rest & ~single, stretches, shifts, int(np.count_nonzero(single)))


def _centre_and_sd(z: Array, smallest_sd: float) -> tuple[float, float]:
    """Median, and robust standard deviation of the values."""
    centre = float(np.median(z))
    half, usual = np.quantile(np.abs(z - centre), (0.5, USUAL_SHARE)).tolist()
    return centre, max(_TO_SD * half, _USUAL_TO_SD * usual, smallest_sd)


def _strange(blocks: list[Array], centre: float, sd: float, smallest_sd: float) -> list[int]:
    """Numbers of the blocks whose mean or spread is unlike the others'."""
    filled = [index for index, block in enumerate(blocks) if block.size >= SMALLEST_BLOCK // 2]
    if len(filled) < 4:
        return []
    # Outliers are not what makes a block strange; without the clip a single one would.
    clipped = [np.clip(blocks[index], centre - OUTLIER * sd, centre + OUTLIER * sd) for index in filled]
    means = np.array([block.mean() for block in clipped])
    spreads = np.log(np.array([max(float(block.std()), smallest_sd, 1e-3 * sd) for block in clipped]))
    rows = float(np.median([block.size for block in clipped]))
    strange = _far(means, max(sd / np.sqrt(rows), smallest_sd)) | _far(spreads, 1.0 / np.sqrt(2.0 * rows))
    return [filled[number] for number in np.flatnonzero(strange)]


def _far(values: Array, smallest_sd: float) -> Mask:
    """Which values are far from the median, seen against how much neighbours differ, and white noise at the least.

    Against neighbours, because a disturbance of two fifths of the blocks widens every measure of all the blocks, but
    makes only two neighbours differ.
    """
    off = np.abs(values - np.median(values))
    sd = _TO_SD * float(np.median(np.abs(np.diff(values)))) / np.sqrt(2.0)
    return np.asarray(off > LARGEST_DEVIATION * max(sd, smallest_sd))


def _stretches(disturbed: Mask) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], disturbed, [False]]).astype(np.int8)))
    return [(int(first), int(end) - 1) for first, end in zip(edges[::2], edges[1::2], strict=True)]
