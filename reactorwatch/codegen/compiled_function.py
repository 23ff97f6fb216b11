"""A CasADi function as machine code that takes row after row.

CasADi keeps a function as a list of operations on numbers and goes through it one by one, which takes some nanoseconds
an operation; of a filter, that are microseconds a row. Its own way to anything faster is to write C, and users have no
compiler. But Numba brings LLVM along (Lattner & Adve 2004, LLVM: a compilation framework for lifelong program analysis
and transformation, CGO), which makes machine code of the same list in some milliseconds: rows are then five times
faster. It is told not to optimise, which would take longer than most functions run for. No operation is left out,
moved or joined with another, so the results are those of CasADi to the last bit.

Rows that do not depend on each other are taken four at a time, and so are four chains of rows if there are several
(see `llvm_ir`), which makes them two to three times faster again.
"""

import ctypes
import hashlib
from collections.abc import Callable, Sequence
from ctypes.util import find_library
from functools import cache, cached_property
from typing import Any, NamedTuple, TypeAlias, cast

import casadi as ca
import llvmlite.binding as llvm
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.cache import users_store
from reactorwatch.codegen.llvm_ir import BEFORE, EACH, SAME, TEXT_VERSION, Frame, check, text_of

LANES = 4
"""Rows, or chains of rows, that are taken at once."""

_Call: TypeAlias = Callable[..., int]


class RowCode:
    """A function of a row, for any number of rows. It is compiled when it is first used.

    Args:
        function: of SX symbols; its arguments are dense, its results are made so.
        shared: which of its arguments are the same for all rows.
        chained: so many of its first arguments are the first results of the row before.
        stops: whether a row whose very last number is not above zero is the last one; of a chained function.

    Raises:
        ValueError: the function has an operation that there is no machine code for.
    """

    def __init__(
        self, function: ca.Function, shared: Sequence[int] = (), chained: int = 0, *, stops: bool = False
    ) -> None:
        symbols = function.sx_in()
        results = [ca.densify(item) for item in function.call(symbols)]
        self._function = ca.Function(function.name(), symbols, results)
        check(self._function)
        kinds = (BEFORE if number < chained else SAME if number in shared else EACH for number in range(len(symbols)))
        self._shapes = [item.shape for item in results]
        counts = tuple(item.numel() for item in results)
        self._frame = Frame(tuple(kinds), tuple(item.numel() for item in symbols), counts, stops)

    def results(self, rows: int) -> list[Array]:
        """Where the results of so many rows fit, each of shape (rows, its columns, its rows), as CasADi keeps them."""
        return [np.empty((rows, *shape[::-1])) for shape in self._shapes]

    def fill(self, rows: int, arguments: Sequence[Array], results: Sequence[Array]) -> int:
        """Take rows.

        Args:
            rows: how many; at least 1.
            arguments: of float64, without gaps in memory; of one that is shared or chained its numbers, column by
                column, else those of row after row.
            results: as `results`, at least for so many rows; they are filled.

        Returns:
            How many rows went well; what is behind them in the results means nothing.

        Raises:
            ValueError: arrays of other sizes or types.
        """
        self._check(rows, arguments, results)
        lanes = not self._frame.chained and rows >= LANES
        return (self._together if lanes else self._alone)(rows, *(item.ctypes.data for item in (*arguments, *results)))

    def fill_together(self, rows: int, arguments: Sequence[Sequence[Array]], results: Sequence[Sequence[Array]]) -> int:
        """Take as many rows of each of some chains.

        Args:
            rows: how many; at least 1.
            arguments: as for `fill`, of each chain; at least one and at most `LANES`.
            results: likewise.

        Returns:
            How many rows went well in all of them; what is behind them in the results means nothing.

        Raises:
            ValueError: as for `fill`.
        """
        for of_chain, into in zip(arguments, results, strict=True):
            self._check(rows, of_chain, into)
        # Where there are fewer chains than lanes the last lanes do the first chain again, somewhere else.
        spare = range(len(arguments), LANES)
        taken = [*arguments, *(arguments[0] for _ in spare)]
        filled = [*results, *([np.empty_like(item) for item in results[0]] for _ in spare)]
        of_lanes = [[item.ctypes.data for item in (*of, *into)] for of, into in zip(taken, filled, strict=True)]
        return self._together(rows, *(address for of_array in zip(*of_lanes, strict=True) for address in of_array))

    def over(self, *arguments: Array) -> list[Array]:
        """The results of all rows, each of shape (rows, its rows, its columns).

        Args:
            *arguments: of one that is shared or chained its numbers, else with one row a row.

        Raises:
            ValueError: none has one row a row, or sizes that do not fit.
        """
        rows = next(len(item) for kind, item in zip(self._frame.kinds, arguments, strict=True) if kind == EACH)
        results = self.results(rows)
        if rows:
            self.fill(rows, [np.ascontiguousarray(item, dtype=np.float64) for item in arguments], results)
        return [item.transpose(0, 2, 1) for item in results]

    def _check(self, rows: int, arguments: Sequence[Array], results: Sequence[Array]) -> None:
        for kind, size, array in zip(self._frame.kinds, self._frame.sizes, arguments, strict=True):
            _check(array, size * (rows if kind == EACH else 1))
        for count, array in zip(self._frame.counts, results, strict=True):
            _check(array, rows * count)

    def prepare(self) -> None:
        """Compile now what is otherwise compiled at the first use."""
        _ = self._alone
        if not self._frame.chained:
            _ = self._together

    @cached_property
    def address(self) -> int:
        """Where the machine code is, for kernels (`compiled.call_at`).

        It takes how many rows, and where arguments and results are, as `fill` does, and lives as long as this object.
        """
        return int(ctypes.cast(cast(Any, self._alone), ctypes.c_void_p).value or 0)

    @cached_property
    def _alone(self) -> _Call:
        return self._compiled(1)

    @cached_property
    def _together(self) -> _Call:
        return self._compiled(LANES)

    def _compiled(self, lanes: int) -> _Call:
        one = self._frame
        frame = Frame(one.kinds, one.sizes, one.counts, one.stops, lanes)
        found = _Machine.of_host().code(self._function, frame)
        pointers = [ctypes.c_void_p] * (frame.chains * (len(frame.sizes) + len(frame.counts)))
        call: _Call = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, *pointers)(found.address)
        self._engines.append(found.engine)
        return call

    @cached_property
    def _engines(self) -> list[llvm.ExecutionEngine]:
        """They keep the code."""
        return []


def _check(array: Array, least: int) -> None:
    if array.dtype != np.float64 or not array.flags.c_contiguous or array.size < least:
        raise ValueError(f"an array of {least} float64 without gaps is needed, got {array.dtype} {array.shape}")


class _Loaded(NamedTuple):
    """Machine code that can be called.

    Attributes:
        engine: keeps it.
        address: where it begins.
    """

    engine: llvm.ExecutionEngine
    address: int


class _Machine:
    """The processor that runs this, and what code was made for it."""

    def __init__(self) -> None:
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        if llvm.address_of_symbol("exp") is None:  # the program has not loaded it for itself
            llvm.load_library_permanently(find_library("m"))
        self._triple = llvm.get_process_triple()
        self._cpu, self._features = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()
        self._store = users_store()

    @classmethod
    @cache
    def of_host(cls) -> "_Machine":
        """That of this process."""
        return cls()

    def code(self, function: ca.Function, frame: Frame) -> _Loaded:
        """Of a function, from the store if it was made before."""
        made_by = (llvm.llvm_version_info, self._triple, self._cpu, self._features, TEXT_VERSION)
        depends_on = repr((made_by, frame)) + function.serialize()
        name = hashlib.sha256(depends_on.encode()).hexdigest()
        machine = self._target()
        stored = self._store.code(
            name, lambda: bytes(machine.emit_object(llvm.parse_assembly(text_of(function, frame))))
        )
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        engine.add_object_file(llvm.ObjectFileRef.from_data(stored))
        engine.finalize_object()
        return _Loaded(engine, engine.get_function_address("rows"))

    def _target(self) -> llvm.TargetMachine:
        target = llvm.Target.from_triple(self._triple)
        return target.create_target_machine(cpu=self._cpu, features=self._features, opt=0, jit=True)
