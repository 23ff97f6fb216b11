"""The compiler of numerical kernels written in Python: Numba.

A streaming estimator updates matrices of seven by seven: the arithmetic takes a third of a microsecond, and one call
into NumPy as long again, of which it would need twenty. Compiled as a whole, the same source serves one plant and ten
thousand, with the same bits.

`fastmath` stays off: the compiler could then reorder sums, and two machines differ.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def jit(kernel: Kernel) -> Kernel:
    """Compile a kernel at its first call and cache it on disk; without a writable folder, in each process.

    Args:
        kernel: a function of numbers and NumPy arrays, in the subset of Python that Numba compiles.
    """
    try:
        return cast(Kernel, numba.njit(cache=True, fastmath=False, error_model="numpy")(kernel))
    except RuntimeError:  # Numba: no locator available
        return cast(Kernel, numba.njit(cache=False, fastmath=False, error_model="numpy")(kernel))


def _call_at(_typing: Any, address: Any, numbers: Any) -> Any:
    """Numba intrinsic: the type of the call, and the function that generates its IR."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        word = ir.IntType(64)
        given = [builder.extract_value(arguments[1], i) for i in range(len(numbers))]
        kind = ir.FunctionType(word, [word] * len(given))
        return builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), given)

    return types.int64(address, numbers), generate


call_at = cast(Callable[[int, tuple[int, ...]], int], intrinsic(_call_at))
"""Call machine code from a kernel: `call_at(address, (number, ...))`.

The numbers and the address are 64-bit integers; an array is passed by its address (`array.ctypes.data`). The caller
keeps the code and the arrays alive.
"""
