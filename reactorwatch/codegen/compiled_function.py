"""A CasADi function compiled to machine code, for many rows in one call.

CasADi interprets a function as a list of scalar operations, at some nanoseconds each; for a filter, that is
microseconds a row. Its own faster path writes C, and users have no compiler. But Numba brings LLVM along (Lattner &
Adve 2004, LLVM: a compilation framework for lifelong program analysis and transformation, CGO), which compiles the same
list in some milliseconds: rows are then five times faster. LLVM's optimisation is off, as it would take longer than
most functions run for. No operation is left out, moved or fused, so the results are CasADi's to the last bit.

Independent rows are taken four at a time, and so are four chains of rows (see `llvm_ir`): two to three times faster
again.

`ArrayFunction` calls one function for one row without converting its arguments and results, which takes a hundred times
as long as the arithmetic of a small one.

Machine code is kept on disk for all processes of a user: a diagnosis fits some sixty models, and compiling them takes a
fifth of its time. An entry is named by a digest of the function, the compiler and the processor, so it is never wrong,
only no longer requested. Where the folder cannot be written to, every process compiles for itself.
"""

import ctypes
import hashlib
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from ctypes.util import find_library
from dataclasses import replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, TypeAlias, cast

import casadi as ca
import llvmlite.binding as llvm
import numpy as np
import platformdirs

from reactorwatch.arrays import Array
from reactorwatch.codegen.llvm_ir import CHAINED, IR_VERSION, PER_ROW, SHARED, RowLoop, check, write_ir
from reactorwatch.progress import report_stage

LANES = 4
"""Number of rows, or chains of rows, in one vector operation: four doubles are the 256 bits of AVX2."""

_Call: TypeAlias = Callable[..., int]


class CompiledFunction:
    """A function of a row, for any number of rows; compiled at its first use.

    Args:
        function: function of SX symbols, with dense arguments; its results are made dense.
        shared: indices of the arguments that are the same for all rows.
        chained: number of leading arguments that are the leading results of the row before.
        stops: whether a chained function stops after a row whose very last number is not above zero.
    """

    def __init__(
        self, function: ca.Function, shared: Sequence[int] = (), chained: int = 0, *, stops: bool = False
    ) -> None:
        self._function = _make_dense(function, function.sx_in())
        kinds = (CHAINED if i < chained else SHARED if i in shared else PER_ROW for i in range(function.n_in()))
        self._shapes = [function.size_out(i) for i in range(function.n_out())]
        sizes, counts = map(function.numel_in, range(function.n_in())), map(function.numel_out, range(function.n_out()))
        self._loop = RowLoop(tuple(kinds), tuple(sizes), tuple(counts), stops)
        self._engines: list[llvm.ExecutionEngine] = []  # they own the code

    def allocate_results(self, rows: int) -> list[Array]:
        """Uninitialised arrays for `fill`, each of shape (rows, columns, rows of the matrix): CasADi's order."""
        return [np.empty((rows, *shape[::-1])) for shape in self._shapes]

    def fill(self, rows: int, arguments: Sequence[Array], results: Sequence[Array]) -> int:
        """Evaluate rows.

        Args:
            rows: number of rows; at least 1.
            arguments: float64, contiguous, matrices column by column; a shared or chained argument once, others for
                row after row.
            results: as `allocate_results` makes them, for at least as many rows; they are filled.

        Returns:
            The number of rows before the function stopped; later results are undefined.

        Raises:
            ValueError: arrays of other sizes or types.
        """
        self._check(rows, arguments, results)
        lanes = not self._loop.chained and rows >= LANES
        return (self._vector_call if lanes else self._scalar_call)(
            rows, *(item.ctypes.data for item in (*arguments, *results))
        )

    def fill_chains(self, rows: int, arguments: Sequence[Sequence[Array]], results: Sequence[Sequence[Array]]) -> int:
        """Evaluate the same number of rows of each of several chains.

        Args:
            rows: number of rows; at least 1.
            arguments: for each chain as for `fill`; at least one chain and at most `LANES`.
            results: for each chain as for `fill`.

        Returns:
            The number of rows before any chain stopped; later results are undefined.

        Raises:
            ValueError: see `fill`.
        """
        for given, into in zip(arguments, results, strict=True):
            self._check(rows, given, into)
        # Lanes without a chain of their own evaluate the first chain again, into arrays that are dropped.
        spare = range(len(arguments), LANES)
        taken = [*arguments, *(arguments[0] for _ in spare)]
        filled = [*results, *([np.empty_like(item) for item in results[0]] for _ in spare)]
        of_lanes = [[item.ctypes.data for item in (*of, *into)] for of, into in zip(taken, filled, strict=True)]
        return self._vector_call(rows, *(address for of_array in zip(*of_lanes, strict=True) for address in of_array))

    def map(self, *arguments: Array) -> list[Array]:
        """Evaluate all rows; returns results of shape (rows, rows of the matrix, columns).

        Args:
            *arguments: a shared or chained argument as it is, others with the rows along the first axis.

        Raises:
            ValueError: an array has a size that does not fit.
        """
        rows = next(len(item) for kind, item in zip(self._loop.kinds, arguments, strict=True) if kind == PER_ROW)
        results = self.allocate_results(rows)
        if rows:
            self.fill(rows, [np.ascontiguousarray(item, dtype=np.float64) for item in arguments], results)
        return [item.transpose(0, 2, 1) for item in results]

    def _check(self, rows: int, arguments: Sequence[Array], results: Sequence[Array]) -> None:
        for kind, size, array in zip(self._loop.kinds, self._loop.sizes, arguments, strict=True):
            _check_array(array, size * (rows if kind == PER_ROW else 1))
        for count, array in zip(self._loop.counts, results, strict=True):
            _check_array(array, rows * count)

    def prepare(self) -> None:
        """Compile now instead of at the first use.

        Raises:
            ValueError: the function has an operation that there is no machine code for.
        """
        _ = self._scalar_call
        if not self._loop.chained:
            _ = self._vector_call

    @cached_property
    def address(self) -> int:
        """Address of the machine code, for kernels (`numba_kernel.call_at`); valid as long as this object lives.

        The code takes the number of rows and the addresses of arguments and results, in the order of `fill`.
        """
        return _address(self._scalar_call)

    @cached_property
    def _scalar_call(self) -> _Call:
        return self._compile(1)

    @cached_property
    def _vector_call(self) -> _Call:
        return self._compile(LANES)

    def _compile(self, lanes: int) -> _Call:
        loop = replace(self._loop, lanes=lanes)
        engine = _host().load(self._function, loop)
        self._engines.append(engine)
        pointers = [ctypes.c_void_p] * (loop.chains * (len(loop.sizes) + len(loop.counts)))
        call: _Call = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, *pointers)(engine.get_function_address("rows"))
        return call


def _make_dense(function: ca.Function, symbols: Sequence[Any]) -> ca.Function:
    """The function of these symbols with dense results; of a large one to make another takes as long as to load it."""
    if all(function.sparsity_out(index).is_dense() for index in range(function.n_out())):
        return function
    return ca.Function(function.name(), symbols, [ca.densify(item) for item in function.call(symbols)])


def _address(call: _Call) -> int:
    return int(ctypes.cast(cast(Any, call), ctypes.c_void_p).value or 0)


def _check_array(array: Array, least: int) -> None:
    if array.dtype != np.float64 or not array.flags.c_contiguous or array.size < least:
        raise ValueError(f"an array of {least} float64 without gaps is needed, got {array.dtype} {array.shape}")


class _Host:
    """The compiler for this processor."""

    def __init__(self) -> None:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        if llvm.address_of_symbol("exp") is None:  # libm is not loaded yet
            llvm.load_library_permanently(find_library("m"))
        self._triple = llvm.get_process_triple()
        self._cpu, self._features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
        self._cache = CodeCache(platformdirs.user_cache_path("reactorwatch") / "machine_code")
        self._compiled = 0

    def load(self, function: ca.Function, loop: RowLoop) -> llvm.ExecutionEngine:
        """Engine with the machine code of a function, from the cache if it was compiled before."""
        made_by = (llvm.llvm_version_info, self._triple, self._cpu, self._features, IR_VERSION)
        depends_on = repr((made_by, loop)) + function.serialize()
        name = hashlib.sha256(depends_on.encode()).hexdigest()
        target = llvm.Target.from_triple(self._triple)
        machine = target.create_target_machine(cpu=self._cpu, features=self._features, opt=0, jit=True)

        def compile_now() -> bytes:
            self._compiled += 1
            report_stage("compiling function", self._compiled)
            check(function)
            return bytes(machine.emit_object(llvm.parse_assembly(write_ir(function, loop))))

        stored = self._cache.get_or_make(name, compile_now)
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        engine.add_object_file(llvm.ObjectFileRef.from_data(stored))
        engine.finalize_object()
        return engine


@cache
def _host() -> _Host:
    """The compiler of this process."""
    return _Host()


class ArrayFunction:
    """Fill `arguments`, call, read `results`; the next call overwrites them.

    CasADi keeps a matrix column by column, so its column is a row of the array: a matrix of shape (n, m) is an array
    of shape (m, n), and a vector of n an array of shape (1, n).

    Args:
        function: the CasADi function; its results are made dense.

    Attributes:
        arguments: one array for each argument.
        results: one array for each result.
    """

    def __init__(self, function: ca.Function) -> None:
        function = _make_dense(function, function.mx_in())
        self.arguments: tuple[Array, ...] = tuple(
            np.zeros(function.size_in(index)[::-1]) for index in range(function.n_in())
        )
        self.results: tuple[Array, ...] = tuple(
            np.zeros(function.size_out(index)[::-1]) for index in range(function.n_out())
        )
        self._buffer, self._evaluate = function.buffer()
        for index, array in enumerate(self.arguments):
            self._buffer.set_arg(index, memoryview(array))  # type: ignore[call-arg,arg-type] # the stub asks for a size
        for index, array in enumerate(self.results):
            self._buffer.set_res(index, memoryview(array))  # type: ignore[call-arg,arg-type] # as above

    def __call__(self) -> None:
        """Evaluate."""
        self._evaluate()

    def call(self, *values: Array | float) -> list[Array]:
        """Evaluate with these arguments; returns copies of the results."""
        for argument, value in zip(self.arguments, values, strict=True):
            argument[:] = value
        self._evaluate()
        return [item.copy() for item in self.results]


_DIGEST_BYTES = hashlib.sha256().digest_size


class CodeCache:
    """A folder of machine code.

    Args:
        folder: folder of the entries; made with the first one.
        capacity: largest number of entries, of some 30 kB each.
        evicted: number of entries that are evicted when there are more: those that were used longest ago.
    """

    def __init__(self, folder: Path, capacity: int = 4000, evicted: int = 1000) -> None:
        self._folder, self._capacity, self._evicted = folder, capacity, evicted
        self._room = 0  # entries that may be stored before the folder is counted again

    def get_or_make(self, name: str, make: Callable[[], bytes]) -> bytes:
        """Return the entry of a name; make and store it if it is missing or damaged.

        Args:
            name: a digest of everything that the code depends on.
            make: compiles the code.
        """
        path = self._folder / name
        try:
            entry = path.read_bytes()
        except OSError:  # missing or unreadable
            entry = b""
        digest, code = entry[:_DIGEST_BYTES], entry[_DIGEST_BYTES:]
        if digest != hashlib.sha256(code).digest():
            code = make()
            self._store(path, code)
        else:
            with suppress(OSError):  # of a folder that is only read, nothing is evicted
                os.utime(path)
        return code

    def _store(self, path: Path, code: bytes) -> None:
        """Write to a temporary file and rename it, as other processes read and write at the same time."""
        temporary = path.with_name(f"{path.name}.{os.getpid()}")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(hashlib.sha256(code).digest() + code)
            temporary.replace(path)
            self._evict()
        except OSError:  # the disk is full or not writable: the code is compiled again next time
            with suppress(OSError):
                temporary.unlink()

    def _evict(self) -> None:
        self._room -= 1
        if self._room >= 0:
            return
        entries = list(os.scandir(self._folder))
        self._room = self._capacity - len(entries)
        if self._room < 0:
            files = (item for item in entries if item.is_file())
            for item in sorted(files, key=lambda item: item.stat().st_mtime_ns)[: self._evicted]:
                Path(item.path).unlink(missing_ok=True)
