"""The one place that knows the compiler of our numerical kernels.

A streaming estimator updates matrices of seven by seven: the arithmetic takes a third of a microsecond, and
one call into NumPy as much again, of which it would need twenty. Compiled as a whole, the same source serves
one plant and ten thousand, and gives both the same bits.

`fastmath` stays off: it would allow the compiler to reorder sums, and two machines to differ.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def compiled(kernel: Kernel) -> Kernel:
    """Compile a numerical kernel to machine code at its first call, and keep the result on disk.

    Args:
        kernel: a function of numbers and NumPy arrays, in the subset of Python that Numba compiles.

    Returns:
        The compiled function; it is called like the original.
    """
    return cast(Kernel, numba.njit(cache=True, fastmath=False, error_model="numpy")(kernel))
