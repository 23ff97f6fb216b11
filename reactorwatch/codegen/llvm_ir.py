"""A CasADi function, row after row, in the language of LLVM.

A processor that waits for one number to be worked out could work out others meanwhile, and has arithmetic for several
at once. So several lanes may be gone together: each value then is a vector with one number a lane. What is done to each
number is the same, so the results are, to the last bit.

The lanes are rows, one after the other, if a row does not depend on the one before; else they are chains of rows that
have nothing to do with each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from struct import pack, unpack

import casadi as ca

TEXT_VERSION = 1
"""Machine code of another one is not taken from the store: raise it whenever the text of a function becomes another."""

SAME, EACH, BEFORE = "same", "each", "before"
"""Kinds of arguments: the same for all rows, one for each, or the result of the row before."""

_ARITHMETIC = {ca.OP_ADD: "fadd", ca.OP_SUB: "fsub", ca.OP_MUL: "fmul", ca.OP_DIV: "fdiv"}
_COMPARED = {ca.OP_LT: "olt", ca.OP_LE: "ole", ca.OP_EQ: "oeq", ca.OP_NE: "une"}
_BOTH = {ca.OP_AND: "and", ca.OP_OR: "or"}
_INTRINSIC = {
    ca.OP_SQRT: "llvm.sqrt",
    ca.OP_FABS: "llvm.fabs",
    ca.OP_FLOOR: "llvm.floor",
    ca.OP_CEIL: "llvm.ceil",
    ca.OP_COPYSIGN: "llvm.copysign",
}
_CALLED = {
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
_KNOWN = {*_ARITHMETIC, *_COMPARED, *_BOTH, *_INTRINSIC, *_CALLED, *_OTHERS}


@dataclass(frozen=True)
class Frame:
    """How a function is taken row after row.

    Attributes:
        kinds: of its arguments.
        sizes: numbers in each.
        counts: numbers in each of its results, all dense.
        stops: whether a row whose very last number is not above zero is the last one.
        lanes: that are gone together.
    """

    kinds: tuple[str, ...]
    sizes: tuple[int, ...]
    counts: tuple[int, ...]
    stops: bool
    lanes: int = 1

    @property
    def chained(self) -> bool:
        """Whether a row depends on the one before, so that lanes are chains and have arrays of their own."""
        return BEFORE in self.kinds

    @property
    def chains(self) -> int:
        """How many arrays stand for each argument and each result."""
        return self.lanes if self.chained else 1


def check(function: ca.Function) -> None:
    """That there is machine code for a function.

    Raises:
        ValueError: it has an operation that there is none for.
    """
    for number in range(function.n_instructions()):
        operation = function.instruction_id(number)
        if operation not in _KNOWN:
            names = [name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == operation]
            raise ValueError(f"there is no machine code for CasADi's operation {' '.join(names)}")


def text_of(function: ca.Function, frame: Frame) -> str:
    """A module with the function `rows`: (count, arrays of arguments, arrays of results) -> rows that went well.

    Of a chained function with several lanes each argument and result has an array a lane, one after the other.

    Args:
        function: of SX symbols, with dense results, that has been checked.
        frame: around it.
    """
    return _Text(function, frame).whole


@dataclass(eq=False)
class _Text:
    """The lines, while they are written."""

    function: ca.Function
    frame: Frame
    _lines: list[str] = field(default_factory=list)
    _declared: dict[str, str] = field(default_factory=dict)
    _names: int = 0

    @property
    def whole(self) -> str:
        """All of it."""
        values: dict[int, str] = {}
        for number in range(self.function.n_instructions()):
            self._add(number, values)
        return self._framed(self._all_good() if self.frame.stops else None)

    def _framed(self, good: str | None) -> str:
        """The loop over the rows, which ends early if not all is good."""
        frame, phis, begin = self.frame, list[str](), list[str]()
        lanes, chains = range(frame.lanes), range(frame.chains)
        for lane in lanes:
            if frame.chained or lane == 0:
                begin.append(f"%row{lane} = add i64 %row, 0")
            else:  # behind the last row the lanes do it again
                begin += [f"%beyond{lane} = add i64 %row, {lane}"]
                begin += [f"%within{lane} = icmp slt i64 %beyond{lane}, %count"]
                begin += [f"%row{lane} = select i1 %within{lane}, i64 %beyond{lane}, i64 %last"]
            array = lane if frame.chained else 0
            for number, (kind, size) in enumerate(zip(frame.kinds, frame.sizes, strict=True)):
                name, of = f"%in{number}_{lane}", f"%a{number}_{array}"
                if kind == BEFORE:
                    phis.append(f"{name} = phi ptr [ {of}, %start ], [ %out{number}_{lane}, %on ]")
                else:
                    begin += [f"{name}s = mul i64 %row{lane}, {size if kind == EACH else 0}"]
                    begin += [f"{name} = getelementptr double, ptr {of}, i64 {name}s"]
            for number, count in enumerate(frame.counts):
                name = f"%out{number}_{lane}"
                begin += [f"{name}s = mul i64 %row{lane}, {count}"]
                begin += [f"{name} = getelementptr double, ptr %r{number}_{array}, i64 {name}s"]
        arguments = [f"ptr %a{number}_{chain}" for number in range(len(frame.sizes)) for chain in chains]
        arguments += [f"ptr %r{number}_{chain}" for number in range(len(frame.counts)) for chain in chains]
        step = 1 if frame.chained else frame.lanes
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

    def _all_good(self) -> str:
        """Whether the row went well in all lanes."""
        number, count = len(self.frame.counts) - 1, self.frame.counts[-1]
        every = "true"
        for lane in range(self.frame.lanes):
            place = self._new(f"getelementptr double, ptr %out{number}_{lane}, i64 {count - 1}")
            value = self._new(f"load double, ptr {place}")
            good = self._new(f"fcmp ogt double {value}, 0.0")
            every = self._new(f"and i1 {every}, {good}")
        return every

    @property
    def _type(self) -> str:
        return "double" if self.frame.lanes == 1 else f"<{self.frame.lanes} x double>"

    @property
    def _truth(self) -> str:
        return "i1" if self.frame.lanes == 1 else f"<{self.frame.lanes} x i1>"

    def _constant(self, value: float) -> str:
        number = f"0x{unpack('<Q', pack('<d', value))[0]:016X}"
        return number if self.frame.lanes == 1 else f"<{', '.join([f'double {number}'] * self.frame.lanes)}>"

    def _new(self, expression: str) -> str:
        self._names += 1
        self._lines.append(f"%v{self._names} = {expression}")
        return f"%v{self._names}"

    def _number(self, truth: str) -> str:
        return self._new(f"uitofp {self._truth} {truth} to {self._type}")

    def _true(self, value: str) -> str:
        return self._new(f"fcmp une {self._type} {value}, {self._constant(0.0)}")

    def _joined(self, values: Sequence[str]) -> str:
        """One vector of the numbers of all lanes."""
        if len(values) == 1:
            return values[0]
        vector = "poison"
        for lane, value in enumerate(values):
            vector = self._new(f"insertelement {self._type} {vector}, double {value}, i32 {lane}")
        return vector

    def _parted(self, vector: str) -> list[str]:
        """The numbers of all lanes."""
        lanes = range(self.frame.lanes)
        if len(lanes) == 1:
            return [vector]
        return [self._new(f"extractelement {self._type} {vector}, i32 {lane}") for lane in lanes]

    def _intrinsic(self, name: str, *arguments: str) -> str:
        full = f"{name}.{'f64' if self.frame.lanes == 1 else f'v{self.frame.lanes}f64'}"
        self._declared[full] = f"declare {self._type} @{full}({', '.join([self._type] * len(arguments))})"
        return self._new(f"call {self._type} @{full}({', '.join(f'{self._type} {item}' for item in arguments)})")

    def _called(self, name: str, *arguments: str) -> str:
        self._declared[name] = f"declare double @{name}({', '.join(['double'] * len(arguments))})"
        of_lanes = zip(*(self._parted(item) for item in arguments), strict=True)
        return self._joined(
            [
                self._new(f"call double @{name}({', '.join(f'double {item}' for item in of_lane)})")
                for of_lane in of_lanes
            ]
        )

    def _add(self, number: int, values: dict[int, str]) -> None:
        """One operation."""
        operation = self.function.instruction_id(number)
        into, of = self.function.instruction_output(number), self.function.instruction_input(number)
        lanes = range(self.frame.lanes)
        if operation == ca.OP_OUTPUT:
            for lane, value in enumerate(self._parted(values[of[0]])):
                place = self._new(f"getelementptr double, ptr %out{into[0]}_{lane}, i64 {into[1]}")
                self._lines.append(f"store double {value}, ptr {place}")
        elif operation == ca.OP_INPUT:
            places = [self._new(f"getelementptr double, ptr %in{of[0]}_{lane}, i64 {of[1]}") for lane in lanes]
            values[into[0]] = self._joined([self._new(f"load double, ptr {place}") for place in places])
        elif operation == ca.OP_CONST:
            values[into[0]] = self._constant(self.function.instruction_constant(number))
        else:
            values[into[0]] = self._worked_out(operation, [values[item] for item in of])

    def _worked_out(self, operation: int, of: list[str]) -> str:
        x, y, numbers = of[0], of[-1], self._type
        if operation in _ARITHMETIC:
            return self._new(f"{_ARITHMETIC[operation]} {numbers} {x}, {y}")
        if operation in _INTRINSIC:
            return self._intrinsic(_INTRINSIC[operation], *of)
        if operation in _CALLED:
            return self._called(_CALLED[operation], *of)
        if operation in _COMPARED:
            return self._number(self._new(f"fcmp {_COMPARED[operation]} {numbers} {x}, {y}"))
        if operation in _BOTH:
            return self._number(self._new(f"{_BOTH[operation]} {self._truth} {self._true(x)}, {self._true(y)}"))
        zero = self._constant(0.0)
        match operation:
            case ca.OP_NOT:
                return self._number(self._new(f"fcmp oeq {numbers} {x}, {zero}"))
            case ca.OP_IF_ELSE_ZERO:
                return self._new(f"select {self._truth} {self._true(x)}, {numbers} {y}, {numbers} {zero}")
            case ca.OP_SIGN:
                positive, negative = (
                    self._number(self._new(f"fcmp {way} {numbers} {x}, {zero}")) for way in ("ogt", "olt")
                )
                sign = self._new(f"fsub {numbers} {positive}, {negative}")
                none = self._new(f"fcmp ueq {numbers} {x}, {zero}")  # of zero and of what is no number it is the same
                return self._new(f"select {self._truth} {none}, {numbers} {x}, {numbers} {sign}")
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
