"""The type of arrays of floating-point numbers, and blocks of the rows of a training."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BLOCKS = 5
"""Blocks of a cross-validation."""


def block_bounds(rows: int) -> list[tuple[int, int]]:
    """First row of each block of a training of so many rows, and the row behind its last.

    >>> block_bounds(12)
    [(0, 2), (2, 4), (4, 7), (7, 9), (9, 12)]
    """
    return list(pairwise(np.linspace(0, rows, BLOCKS + 1).astype(int).tolist()))
