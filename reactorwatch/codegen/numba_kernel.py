"""The compiler of numerical kernels written in Python: Numba.

A streaming estimator updates matrices of seven by seven: the arithmetic takes a third of a microsecond, and one call
into NumPy as long again, of which it would need twenty. Compiled as a whole, the same source serves one plant and ten
thousand, with the same bits.

`fastmath` stays off: the compiler could then reorder sums, and two machines differ.
"""

import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

_log = logging.getLogger(__name__)

Kernel = TypeVar("Kernel", bound=Callable[..., Any])
Values = TypeVar("Values")

_OPTIONS: dict[str, Any] = {"fastmath": False, "error_model": "numpy"}


def jit(kernel: Kernel) -> Kernel:
    """Compile a kernel at its first call and cache it on disk; without a writable folder, in each process.

    Args:
        kernel: a function of numbers and NumPy arrays, in the subset of Python that Numba compiles.
    """
    try:
        compiled = numba.njit(cache=True, **_OPTIONS)(kernel)
    except RuntimeError:  # Numba: no locator available
        return cast(Kernel, numba.njit(cache=False, **_OPTIONS)(kernel))
    _tolerate_cache_failures(compiled)
    return cast(Kernel, compiled)


def inline(kernel: Kernel) -> Kernel:
    """Compile a kernel as a part of each kernel that calls it, which has it in its cache; arguments as for `jit`.

    For kernels that are given tuples of arrays: at each call Numba counts a reference to each array of a tuple, which
    in the step of a plant's row took longer than the arithmetic. In one piece of code it sees what needs no count.
    """
    return cast(Kernel, numba.njit(forceinline=True, **_OPTIONS)(kernel))


def _tolerate_cache_failures(compiled: Any) -> None:
    """Let a kernel work where its cache cannot be written, or names modules of another version that are gone."""
    cache = compiled._cache
    save, load = cache.save_overload, cache.load_overload

    def save_overload(signature: Any, code: Any) -> None:
        try:
            save(signature, code)
        except OSError as error:
            _log.debug("the machine code of %s is not cached: %s", compiled.__name__, error)

    def load_overload(signature: Any, target: Any) -> Any:
        try:
            return load(signature, target)
        except (ImportError, AttributeError) as error:
            _log.debug("the cached machine code of %s is of another version: %s", compiled.__name__, error)
            cache.flush()
            return None

    cache.save_overload, cache.load_overload = save_overload, load_overload


def python_function(kernel: Kernel) -> Kernel:
    """Python function of a kernel of `jit`, for objects: the same operations, bit for bit."""
    return cast(Kernel, cast(Any, kernel).py_func)


_KINDS = {int: types.int64, float: types.float64, bool: types.boolean}


class Entry:
    """Kernel that is always called with arguments of the same types, from Python, for one plant.

    Numba finds the machine code for the types of the arguments at each call; for arrays of records that takes a
    microsecond, four times as long as a step. So the code for the arrays of the first call is kept.

    Args:
        kernel: a kernel of `jit`. Its arguments are C-contiguous arrays, and numbers annotated as int, float or bool.
    """

    def __init__(self, kernel: Callable[..., Any]) -> None:
        self._kernel: Any = kernel
        self.call: Callable[..., Any] = self._compile

    def _compile(self, *arguments: Any) -> Any:
        typeof: Callable[[Any], Any] = numba.typeof
        declared = list(self._kernel.py_func.__annotations__.values())[: len(arguments)]
        kinds = tuple(_KINDS.get(kind) or typeof(argument) for kind, argument in zip(declared, arguments, strict=True))
        self._kernel.compile(kinds)
        self.call = self._kernel.overloads[kinds].entry_point
        return self.call(*arguments)


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


def _pointer_at(_typing: Any, address: Any) -> Any:
    """Numba intrinsic: the type of the conversion, and the function that generates its IR."""

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(address), generate


pointer_at = cast(Callable[[int], Any], intrinsic(_pointer_at))
"""Pointer to an address, for `numba.carray` in a kernel: an array whose owner the caller keeps alive."""


def _borrow(_typing: Any, array: Any) -> Any:
    """Numba intrinsic: the type of the array, and the function that generates its IR."""

    def generate(context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        view = context.make_array(array)(context, builder, arguments[0])
        view.meminfo = ir.Constant(view.meminfo.type, None)
        return view._getvalue()

    return array(array), generate


borrow = cast(Callable[[Values], Values], intrinsic(_borrow))
"""The same array without its owner, whose references Numba would count at each use; the caller keeps it alive."""

carray: Any = numba.carray  # type: ignore[attr-defined]
"""Array at a pointer, of a shape and a type, without a copy."""
