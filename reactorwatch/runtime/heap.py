"""Heap of the C library: large blocks return to the system as soon as they are free.

glibc maps blocks above a threshold one by one and unmaps them. When the first of them is freed it raises the threshold
to the size of that block (up to 32 MB), and takes the next from the heap, where small blocks behind it keep its memory
from returning (mallopt(3), M_MMAP_THRESHOLD). A monitor that received payloads of 10 MB for a quarter of an hour grew
by 35 MB from its sixth minute to its last, of which it used 2 MB.
"""

import ctypes

LARGE_BYTES = 4 << 20
"""Four times the largest payload that a node reads: normal operation has no such blocks."""

_M_MMAP_THRESHOLD = -3  # malloc.h


def release_large_blocks() -> bool:
    """Keep the threshold at `LARGE_BYTES` for the whole process; returns False where the C library has none."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and mallopt(_M_MMAP_THRESHOLD, LARGE_BYTES) == 1
