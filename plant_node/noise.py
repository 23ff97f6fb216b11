"""Random numbers by row of the run.

The number of row k is a function of (seed, stream, k), drawn in blocks with a generator each. So it depends neither on
the first row of a run nor on any other stream: without noise in C, that in T is the same to the last bit.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

BLOCK = 1024  # rows


def standard_normal(seed: int, stream: str, row: int) -> float:
    """Draw a standard normal number, a deterministic function of the arguments."""
    return float(_block(seed, stream, row // BLOCK)[row % BLOCK])


@lru_cache(maxsize=32)
def _block(seed: int, stream: str, block: int) -> NDArray[np.float64]:
    sequence = np.random.SeedSequence([seed, int.from_bytes(stream.encode()), block])
    return np.random.default_rng(sequence).standard_normal(BLOCK)
