"""The one place that knows the compiler of our numerical kernels.

A streaming estimator updates matrices of seven by seven: the arithmetic takes a third of a microsecond, and
one call into NumPy as much again, of which it would need twenty. Compiled as a whole, the same source serves
one plant and ten thousand, and gives both the same bits.

`fastmath` stays off: it would allow the compiler to reorder sums, and two machines to differ.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def compiled(kernel: Kernel) -> Kernel:
    """Compile a numerical kernel to machine code at its first call, and keep the result on disk.

    Where no folder for it can be written to, each process compiles it for itself.

    Args:
        kernel: a function of numbers and NumPy arrays, in the subset of Python that Numba compiles.

    Returns:
        The compiled function; it is called like the original.
    """
    try:
        return cast(Kernel, numba.njit(cache=True, fastmath=False, error_model="numpy")(kernel))
    except RuntimeError:  # Numba's word for it: no locator available
        return cast(Kernel, numba.njit(cache=False, fastmath=False, error_model="numpy")(kernel))


def _call_at(_typing: Any, address: Any, numbers: Any) -> Any:
    """The type of a call of machine code, and what writes it."""

    def written(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        word = ir.IntType(64)
        given = [builder.extract_value(arguments[1], place) for place in range(len(numbers))]
        kind = ir.FunctionType(word, [word] * len(given))
        return builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), given)

    return types.int64(address, numbers), written


call_at = cast(Callable[[int, tuple[int, ...]], int], intrinsic(_call_at))
"""Call machine code from a kernel: `call_at(address, (number, ...))`.

All numbers are of 64 bits, and so is the address. Where arrays are (`array.ctypes.data`) is a number, too. Who hands
such an address to a kernel has to keep what is there.
"""
