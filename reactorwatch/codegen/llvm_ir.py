"""LLVM intermediate representation (IR) of a CasADi function and of the loop that calls it row after row.

A processor that waits for one result could compute others meanwhile, and has vector instructions. So several lanes may
be evaluated together: each value is then a vector with one element a lane. Each element goes through the same
operations, so the results are the same to the last bit.

If a row does not depend on the one before, the lanes are consecutive rows; else they are independent chains of rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from struct import pack, unpack

import casadi as ca

IR_VERSION = 1
"""Version of the generated IR, part of a cache entry's name: raise it whenever the IR of a function changes."""

SHARED, PER_ROW, CHAINED = "same", "each", "before"
"""Kinds of arguments: the same for all rows, one a row, or the result of the row before."""

_ARITHMETIC = {ca.OP_ADD: "fadd", ca.OP_SUB: "fsub", ca.OP_MUL: "fmul", ca.OP_DIV: "fdiv"}
_COMPARISON = {ca.OP_LT: "olt", ca.OP_LE: "ole", ca.OP_EQ: "oeq", ca.OP_NE: "une"}
_LOGICAL = {ca.OP_AND: "and", ca.OP_OR: "or"}
_INTRINSIC = {
    ca.OP_SQRT: "llvm.sqrt",
    ca.OP_FABS: "llvm.fabs",
    ca.OP_FLOOR: "llvm.floor",
    ca.OP_CEIL: "llvm.ceil",
    ca.OP_COPYSIGN: "llvm.copysign",
}
_LIBRARY = {
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
_OTHERS = {
    *(ca.OP_INPUT, ca.OP_OUTPUT, ca.OP_CONST, ca.OP_NOT, ca.OP_IF_ELSE_ZERO, ca.OP_SIGN, ca.OP_SQ, ca.OP_TWICE),
    *(ca.OP_INV, ca.OP_NEG, ca.OP_ASSIGN),
}
_SUPPORTED = {*_ARITHMETIC, *_COMPARISON, *_LOGICAL, *_INTRINSIC, *_LIBRARY, *_OTHERS}


@dataclass(frozen=True)
class RowLoop:
    """Layout of the loop over rows.

    Attributes:
        kinds: kind of each argument.
        sizes: number of elements of each argument.
        counts: number of elements of each result, all dense.
        stops: whether the loop ends after a row whose very last number is not above zero.
        lanes: number of elements of a vector.
    """

    kinds: tuple[str, ...]
    sizes: tuple[int, ...]
    counts: tuple[int, ...]
    stops: bool
    lanes: int = 1

    @property
    def chained(self) -> bool:
        """True if a row depends on the one before; lanes are then chains with arrays of their own."""
        return CHAINED in self.kinds

    @property
    def chains(self) -> int:
        """Number of arrays of each argument and each result."""
        return self.lanes if self.chained else 1


def check(function: ca.Function) -> None:
    """Check that every operation of a function is supported.

    Raises:
        ValueError: there is no machine code for an operation.
    """
    for operation in set(map(function.instruction_id, range(function.n_instructions()))) - _SUPPORTED:
        names = [name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == operation]
        raise ValueError(f"there is no machine code for CasADi's operation {' '.join(names)}")


def write_ir(function: ca.Function, loop: RowLoop) -> str:
    """Write a module with the function `rows`: (count, argument arrays, result arrays) -> rows before it stopped.

    Args:
        function: function of SX symbols, with dense results, that passed `check`.
        loop: the loop around it. A chained one with several lanes has an array a lane for each argument and result.
    """
    return _Writer(function, loop).write()


@dataclass(eq=False)
class _Writer:
    """The lines written so far."""

    function: ca.Function
    loop: RowLoop
    _lines: list[str] = field(default_factory=list)
    _declared: dict[str, str] = field(default_factory=dict)
    _count: int = 0

    def write(self) -> str:
        """Write the module."""
        values: dict[int, str] = {}
        for i in range(self.function.n_instructions()):
            self._add_instruction(i, values)
        return self._wrap_in_loop(self._and_of_flags() if self.loop.stops else None)

    def _wrap_in_loop(self, good: str | None) -> str:
        """Wrap the lines in the loop over rows, which ends early where `good` is false."""
        loop, phis, begin = self.loop, list[str](), list[str]()
        lanes, chains = range(loop.lanes), range(loop.chains)
        for lane in lanes:
            if loop.chained or lane == 0:
                begin.append(f"%row{lane} = add i64 %row, 0")
            else:  # beyond the last row a lane repeats it
                begin += [f"%beyond{lane} = add i64 %row, {lane}"]
                begin += [f"%within{lane} = icmp slt i64 %beyond{lane}, %count"]
                begin += [f"%row{lane} = select i1 %within{lane}, i64 %beyond{lane}, i64 %last"]
            array = lane if loop.chained else 0
            for number, (kind, size) in enumerate(zip(loop.kinds, loop.sizes, strict=True)):
                name, of = f"%in{number}_{lane}", f"%a{number}_{array}"
                if kind == CHAINED:
                    phis.append(f"{name} = phi ptr [ {of}, %start ], [ %out{number}_{lane}, %on ]")
                else:
                    begin += [f"{name}s = mul i64 %row{lane}, {size if kind == PER_ROW else 0}"]
                    begin += [f"{name} = getelementptr double, ptr {of}, i64 {name}s"]
            for number, count in enumerate(loop.counts):
                name = f"%out{number}_{lane}"
                begin += [f"{name}s = mul i64 %row{lane}, {count}"]
                begin += [f"{name} = getelementptr double, ptr %r{number}_{array}, i64 {name}s"]
        arguments = [f"ptr %a{number}_{chain}" for number in range(len(loop.sizes)) for chain in chains]
        arguments += [f"ptr %r{number}_{chain}" for number in range(len(loop.counts)) for chain in chains]
        step = 1 if loop.chained else loop.lanes
        return "\n".join(
            [
                *self._declared.values(),
                f"define i64 @rows(i64 %count, {', '.join(arguments)}) {{",
                *("start:", "%last = sub i64 %count, 1", "br label %each"),
                *("each:", "%row = phi i64 [ 0, %start ], [ %next, %on ]"),
                *(*phis, *begin, *self._lines),
                "br label %on" if good is None else f"br i1 {good}, label %on, label %stop",
                *("on:", f"%next = add i64 %row, {step}", "%more = icmp slt i64 %next, %count"),
                *("br i1 %more, label %each, label %done", "done:", "ret i64 %count"),
                *(() if good is None else ("stop:", "ret i64 %row")),
                "}",
            ]
        )

    def _and_of_flags(self) -> str:
        """A truth value: the last number of the results is above zero in all lanes."""
        last, count = len(self.loop.counts) - 1, self.loop.counts[-1]
        every = "true"
        for lane in range(self.loop.lanes):
            pointer = self._new(f"getelementptr double, ptr %out{last}_{lane}, i64 {count - 1}")
            value = self._new(f"load double, ptr {pointer}")
            good = self._new(f"fcmp ogt double {value}, 0.0")
            every = self._new(f"and i1 {every}, {good}")
        return every

    @property
    def _type(self) -> str:
        return "double" if self.loop.lanes == 1 else f"<{self.loop.lanes} x double>"

    @property
    def _bool_type(self) -> str:
        return "i1" if self.loop.lanes == 1 else f"<{self.loop.lanes} x i1>"

    def _constant(self, value: float) -> str:
        number = f"0x{unpack('<Q', pack('<d', value))[0]:016X}"
        return number if self.loop.lanes == 1 else f"<{', '.join([f'double {number}'] * self.loop.lanes)}>"

    def _new(self, expression: str) -> str:
        self._count += 1
        self._lines.append(f"%v{self._count} = {expression}")
        return f"%v{self._count}"

    def _to_double(self, truth: str) -> str:
        return self._new(f"uitofp {self._bool_type} {truth} to {self._type}")

    def _to_bool(self, value: str) -> str:
        return self._new(f"fcmp une {self._type} {value}, {self._constant(0.0)}")

    def _pack(self, values: Sequence[str]) -> str:
        """Make one vector of the elements of all lanes."""
        if len(values) == 1:
            return values[0]
        vector = "poison"
        for lane, value in enumerate(values):
            vector = self._new(f"insertelement {self._type} {vector}, double {value}, i32 {lane}")
        return vector

    def _unpack(self, vector: str) -> list[str]:
        """Split a vector into the elements of all lanes."""
        lanes = range(self.loop.lanes)
        if len(lanes) == 1:
            return [vector]
        return [self._new(f"extractelement {self._type} {vector}, i32 {lane}") for lane in lanes]

    def _intrinsic(self, name: str, *arguments: str) -> str:
        full = f"{name}.{'f64' if self.loop.lanes == 1 else f'v{self.loop.lanes}f64'}"
        self._declared[full] = f"declare {self._type} @{full}({', '.join([self._type] * len(arguments))})"
        return self._new(f"call {self._type} @{full}({', '.join(f'{self._type} {item}' for item in arguments)})")

    def _call_library(self, name: str, *arguments: str) -> str:
        self._declared[name] = f"declare double @{name}({', '.join(['double'] * len(arguments))})"
        of_lanes = zip(*(self._unpack(item) for item in arguments), strict=True)
        return self._pack(
            [
                self._new(f"call double @{name}({', '.join(f'double {item}' for item in of_lane)})")
                for of_lane in of_lanes
            ]
        )

    def _add_instruction(self, index: int, values: dict[int, str]) -> None:
        operation = self.function.instruction_id(index)
        into, of = self.function.instruction_output(index), self.function.instruction_input(index)
        if operation == ca.OP_OUTPUT:
            for lane, value in enumerate(self._unpack(values[of[0]])):
                pointer = self._new(f"getelementptr double, ptr %out{into[0]}_{lane}, i64 {into[1]}")
                self._lines.append(f"store double {value}, ptr {pointer}")
        elif operation == ca.OP_INPUT:
            lanes = range(self.loop.lanes)
            pointers = [self._new(f"getelementptr double, ptr %in{of[0]}_{lane}, i64 {of[1]}") for lane in lanes]
            values[into[0]] = self._pack([self._new(f"load double, ptr {pointer}") for pointer in pointers])
        elif operation == ca.OP_CONST:
            values[into[0]] = self._constant(self.function.instruction_constant(index))
        else:
            values[into[0]] = self._operation(operation, [values[item] for item in of])

    def _operation(self, operation: int, of: list[str]) -> str:
        x, y, numbers = of[0], of[-1], self._type
        if operation in _ARITHMETIC:
            return self._new(f"{_ARITHMETIC[operation]} {numbers} {x}, {y}")
        if operation in _INTRINSIC:
            return self._intrinsic(_INTRINSIC[operation], *of)
        if operation in _LIBRARY:
            return self._call_library(_LIBRARY[operation], *of)
        if operation in _COMPARISON:
            return self._to_double(self._new(f"fcmp {_COMPARISON[operation]} {numbers} {x}, {y}"))
        if operation in _LOGICAL:
            return self._to_double(
                self._new(f"{_LOGICAL[operation]} {self._bool_type} {self._to_bool(x)}, {self._to_bool(y)}")
            )
        zero = self._constant(0.0)
        match operation:
            case ca.OP_NOT:
                return self._to_double(self._new(f"fcmp oeq {numbers} {x}, {zero}"))
            case ca.OP_IF_ELSE_ZERO:
                return self._new(f"select {self._bool_type} {self._to_bool(x)}, {numbers} {y}, {numbers} {zero}")
            case ca.OP_SIGN:
                positive, negative = (
                    self._to_double(self._new(f"fcmp {way} {numbers} {x}, {zero}")) for way in ("ogt", "olt")
                )
                sign = self._new(f"fsub {numbers} {positive}, {negative}")
                none = self._new(f"fcmp ueq {numbers} {x}, {zero}")  # zero and NaN are their own sign
                return self._new(f"select {self._bool_type} {none}, {numbers} {x}, {numbers} {sign}")
            case ca.OP_SQ:
                return self._new(f"fmul {numbers} {x}, {x}")
            case ca.OP_TWICE:
                return self._new(f"fadd {numbers} {x}, {x}")
            case ca.OP_INV:
                return self._new(f"fdiv {numbers} {self._constant(1.0)}, {x}")
            case ca.OP_NEG:
                return self._new(f"fneg {numbers} {x}")
            case _:  # OP_ASSIGN
                return x
