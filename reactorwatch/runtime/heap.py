"""The heap of the C library: large blocks go back to the system as soon as they are free.

glibc takes blocks above a threshold from the system one by one and gives them back. When the first of them is freed it
raises the threshold to the size of that block (up to 32 MB), and takes the next from a heap, where small blocks come to
lie behind it and keep its room from going back (mallopt(3), M_MMAP_THRESHOLD). A monitor to which payloads of 10 MB
were sent for a quarter of an hour took 35 MB more from its sixth minute to its last, of which it used 2 MB.
"""

import ctypes

LARGE_BYTES = 4 << 20
"""Four times the largest payload that a node reads: in its usual work a node has no such blocks."""

_M_MMAP_THRESHOLD = -3  # malloc.h


def return_large_blocks() -> bool:
    """Keep the threshold at `LARGE_BYTES` for the whole process; returns False where the C library has none."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    return mallopt is not None and mallopt(_M_MMAP_THRESHOLD, LARGE_BYTES) == 1
