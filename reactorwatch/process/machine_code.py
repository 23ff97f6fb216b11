"""A CasADi function as machine code that takes row after row.

CasADi keeps a function as a list of operations on numbers and goes through it one by one, which takes some nanoseconds
an operation; of a filter, that are microseconds a row. Its own way to anything faster is to write C, and users have no
compiler. But Numba brings LLVM along (Lattner & Adve 2004, LLVM: a compilation framework for lifelong program analysis
and transformation, CGO), which makes machine code of the same list in some milliseconds: rows are then five times
faster. It is told not to optimise, which would take longer than most functions run for. No operation is left out,
moved or joined with another, so the results are those of CasADi to the last bit.
"""

import ctypes
from collections.abc import Callable, Sequence
from ctypes.util import find_library
from struct import pack, unpack

import casadi as ca
import llvmlite.binding as llvm
import numpy as np

from reactorwatch.process.model import Array

_ARITHMETIC = {ca.OP_ADD: "fadd", ca.OP_SUB: "fsub", ca.OP_MUL: "fmul", ca.OP_DIV: "fdiv"}
_COMPARED = {ca.OP_LT: "olt", ca.OP_LE: "ole", ca.OP_EQ: "oeq", ca.OP_NE: "une"}
_BOTH = {ca.OP_AND: "and", ca.OP_OR: "or"}
_CALLED = {
    ca.OP_SQRT: "llvm.sqrt.f64",
    ca.OP_FABS: "llvm.fabs.f64",
    ca.OP_FLOOR: "llvm.floor.f64",
    ca.OP_CEIL: "llvm.ceil.f64",
    ca.OP_COPYSIGN: "llvm.copysign.f64",
    ca.OP_FMIN: "fmin",
    ca.OP_FMAX: "fmax",
    ca.OP_POW: "pow",
    ca.OP_CONSTPOW: "pow",
    **{
        getattr(ca, f"OP_{name.upper()}"): name
        for name in (
            *("exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh", "asinh", "acosh"),
            *("atanh", "erf", "log1p", "expm1", "fmod", "atan2", "hypot"),
        )
    },
}

_SAME, _EACH, _BEFORE = "same", "each", "before"


class RowCode:
    """A function of a row, for any number of rows.

    Args:
        function: of SX symbols; its arguments are dense, its results are made so.
        shared: which of its arguments are the same for all rows.
        chained: so many of its first arguments are the first results of the row before.
        stops: whether a row whose very last number is not above zero is the last one.

    Attributes:
        address: of the machine code, for kernels (`compiled.call_at`): it takes the rows and the addresses of arguments
            and results, as `fill` does, and lives as long as this does.

    Raises:
        ValueError: the function has an operation that there is no machine code for.
    """

    def __init__(
        self, function: ca.Function, shared: Sequence[int] = (), chained: int = 0, *, stops: bool = False
    ) -> None:
        symbols = function.sx_in()
        results = [ca.densify(item) for item in function.call(symbols)]
        function = ca.Function(function.name(), symbols, results)
        self._kinds = [
            _BEFORE if number < chained else _SAME if number in shared else _EACH for number in range(len(symbols))
        ]
        self._sizes = [item.numel() for item in symbols]
        self._shapes = [item.shape for item in results]
        self._engine, self.address = _machine_code(_Text(function, self._kinds, self._sizes, self._shapes, stops).whole)
        pointers = [ctypes.c_void_p] * (len(symbols) + len(results))
        self._call: Callable[..., int] = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, *pointers)(self.address)

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
        for kind, size, array in zip(self._kinds, self._sizes, arguments, strict=True):
            _check(array, size * (rows if kind == _EACH else 1))
        for shape, array in zip(self._shapes, results, strict=True):
            _check(array, rows * shape[0] * shape[1])
        return self._call(rows, *(item.ctypes.data for item in (*arguments, *results)))

    def over(self, *arguments: Array) -> list[Array]:
        """The results of all rows, each of shape (rows, its rows, its columns).

        Args:
            *arguments: of one that is shared or chained its numbers, else with one row a row.

        Raises:
            ValueError: none has one row a row, or sizes that do not fit.
        """
        rows = next(len(item) for kind, item in zip(self._kinds, arguments, strict=True) if kind == _EACH)
        results = self.results(rows)
        if rows:
            self.fill(rows, [np.ascontiguousarray(item, dtype=np.float64) for item in arguments], results)
        return [item.transpose(0, 2, 1) for item in results]


def _check(array: Array, least: int) -> None:
    if array.dtype != np.float64 or not array.flags.c_contiguous or array.size < least:
        raise ValueError(f"an array of {least} float64 without gaps is needed, got {array.dtype} {array.shape}")


class _Text:
    """A function in the language of LLVM."""

    def __init__(
        self,
        function: ca.Function,
        kinds: Sequence[str],
        sizes: Sequence[int],
        shapes: Sequence[tuple[int, int]],
        stops: bool,
    ) -> None:
        self._lines: list[str] = []
        self._declared: dict[str, int] = {}
        self._names = 0
        values: dict[int, str] = {}
        for number in range(function.n_instructions()):
            self._add(function, number, values)
        counts = [shape[0] * shape[1] for shape in shapes]
        self.whole = self._framed(kinds, sizes, counts, stops)

    def _framed(self, kinds: Sequence[str], sizes: Sequence[int], counts: Sequence[int], stops: bool) -> str:
        """The loop over the rows."""
        head, begin = [], []
        for number, (kind, size) in enumerate(zip(kinds, sizes, strict=True)):
            if kind == _BEFORE:
                head.append(f"%in{number} = phi ptr [ %a{number}, %start ], [ %out{number}, %on ]")
            elif kind == _EACH:
                begin += [f"%s{number} = mul i64 %row, {size}"]
                begin += [f"%in{number} = getelementptr double, ptr %a{number}, i64 %s{number}"]
            else:
                begin.append(f"%in{number} = getelementptr double, ptr %a{number}, i64 0")
        for number, count in enumerate(counts):
            begin += [f"%t{number} = mul i64 %row, {count}"]
            begin += [f"%out{number} = getelementptr double, ptr %r{number}, i64 %t{number}"]
        last = [f"%p = getelementptr double, ptr %out{len(counts) - 1}, i64 {counts[-1] - 1}"]
        last += ["%good = load double, ptr %p", "%well = fcmp ogt double %good, 0.0"]
        arguments = [f"ptr %a{number}" for number in range(len(sizes))] + [f"ptr %r{n}" for n in range(len(counts))]
        declared = [f"declare double @{name}({', '.join(['double'] * n)})" for name, n in self._declared.items()]
        return "\n".join(
            [
                *declared,
                f"define i64 @rows(i64 %count, {', '.join(arguments)}) {{",
                *("start:", "br label %each", "each:", "%row = phi i64 [ 0, %start ], [ %next, %on ]"),
                *(*head, *begin, *self._lines),
                *((*last, "br i1 %well, label %on, label %stop") if stops else ("br label %on",)),
                *("on:", "%next = add i64 %row, 1", "%more = icmp slt i64 %next, %count"),
                *("br i1 %more, label %each, label %done", "done:", "ret i64 %count"),
                *(("stop:", "ret i64 %row") if stops else ()),
                "}",
            ]
        )

    def _new(self, expression: str) -> str:
        self._names += 1
        self._lines.append(f"%v{self._names} = {expression}")
        return f"%v{self._names}"

    def _number(self, truth: str) -> str:
        return self._new(f"uitofp i1 {truth} to double")

    def _called(self, name: str, *arguments: str) -> str:
        self._declared[name] = len(arguments)
        return self._new(f"call double @{name}({', '.join(f'double {item}' for item in arguments)})")

    def _add(self, function: ca.Function, number: int, values: dict[int, str]) -> None:
        """One operation."""
        operation = function.instruction_id(number)
        into, of = function.instruction_output(number), function.instruction_input(number)
        if operation == ca.OP_OUTPUT:
            place = self._new(f"getelementptr double, ptr %out{into[0]}, i64 {into[1]}")
            self._lines.append(f"store double {values[of[0]]}, ptr {place}")
        elif operation == ca.OP_INPUT:
            place = self._new(f"getelementptr double, ptr %in{of[0]}, i64 {of[1]}")
            values[into[0]] = self._new(f"load double, ptr {place}")
        elif operation == ca.OP_CONST:
            values[into[0]] = _constant(function.instruction_constant(number))
        else:
            values[into[0]] = self._worked_out(operation, [values[item] for item in of])

    def _worked_out(self, operation: int, of: list[str]) -> str:
        x, y = of[0], of[-1]
        if operation in _ARITHMETIC:
            return self._new(f"{_ARITHMETIC[operation]} double {x}, {y}")
        if operation in _CALLED:
            return self._called(_CALLED[operation], *of)
        if operation in _COMPARED:
            return self._number(self._new(f"fcmp {_COMPARED[operation]} double {x}, {y}"))
        if operation in _BOTH:
            return self._number(self._new(f"{_BOTH[operation]} i1 {self._true(x)}, {self._true(y)}"))
        match operation:
            case ca.OP_NOT:
                return self._number(self._new(f"fcmp oeq double {x}, 0.0"))
            case ca.OP_IF_ELSE_ZERO:
                return self._new(f"select i1 {self._true(x)}, double {y}, double 0.0")
            case ca.OP_SIGN:
                positive, negative = (self._number(self._new(f"fcmp {way} double {x}, 0.0")) for way in ("ogt", "olt"))
                sign = self._new(f"fsub double {positive}, {negative}")
                none = self._new(f"fcmp ueq double {x}, 0.0")  # of zero and of what is no number it is the same
                return self._new(f"select i1 {none}, double {x}, double {sign}")
            case ca.OP_SQ:
                return self._new(f"fmul double {x}, {x}")
            case ca.OP_TWICE:
                return self._new(f"fadd double {x}, {x}")
            case ca.OP_INV:
                return self._new(f"fdiv double {_constant(1.0)}, {x}")
            case ca.OP_NEG:
                return self._new(f"fneg double {x}")
            case ca.OP_ASSIGN:
                return x
            case _:
                names = [name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == operation]
                raise ValueError(f"there is no machine code for CasADi's operation {' '.join(names)}")

    def _true(self, value: str) -> str:
        return self._new(f"fcmp une double {value}, 0.0")


def _constant(value: float) -> str:
    return f"0x{unpack('<Q', pack('<d', value))[0]:016X}"


def _machine_code(text: str) -> tuple[llvm.ExecutionEngine, int]:
    """What keeps the machine code, and where it begins."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    if llvm.address_of_symbol("exp") is None:  # the program has not loaded it for itself
        llvm.load_library_permanently(find_library("m"))
    module = llvm.parse_assembly(text)
    machine = llvm.Target.from_default_triple().create_target_machine(opt=0)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    address = engine.get_function_address("rows")
    engine.remove_module(module)  # the code stays, without what it was made of
    return engine, address
