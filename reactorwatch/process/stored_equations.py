"""Equations of a model as data: a file that holds them needs no code of the user.

All expressions are computed by one list of steps. A step is a constant `["const", 1.5]`, a symbol by its index among
states, inputs, parameters and the two symbols of time `["symbol", 3]`, or an operation on earlier steps by their
indices `["mul", 0, 2]`. The operations are those of CasADi's scalar expressions, under CasADi's names.
"""

from collections.abc import Iterable, Mapping
from math import inf, isfinite
from typing import Any

import casadi as ca
import msgspec

from reactorwatch.errors import InputError
from reactorwatch.limits import limits
from reactorwatch.process.model import Output, Parameter, Place, ProcessModel, Variable, new_clock

Step = tuple[int | float | str, ...]

_UNARY = (
    "neg exp log sqrt sq twice sin cos tan asin acos atan not floor ceil fabs sign erf erfinv inv sinh cosh tanh asinh "
    "acosh atanh log1p expm1"
)
_BINARY = "add sub mul div pow constpow lt le eq ne and or fmod copysign fmin fmax atan2 hypot remainder if_else_zero"
UNARY, BINARY = frozenset(_UNARY.split()), frozenset(_BINARY.split())

_CODES = {name: getattr(ca, f"OP_{name.upper()}") for name in (*UNARY, *BINARY)}
_NAMES = {code: name for name, code in _CODES.items()}


class StoredVariable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A state, an input or a parameter; `lower` and `upper` are None where there is no bound."""

    name: str
    unit: str
    meaning: str
    lower: float | None = None
    upper: float | None = None
    value: float | None = None
    scale: float | None = None
    balance: str = ""
    usual: float | None = None


class StoredOutput(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Name and unit of an output."""

    name: str
    unit: str


class StoredEquations(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """A model without its name.

    Attributes:
        states: the states.
        inputs: the inputs.
        parameters: the parameters with their values.
        outputs: the outputs.
        steps: see the module.
        results: index of the step of each expression: the rates of the states, the outputs, the offset of time, then
            the named expressions in their order.
        terms: names of the terms.
        at_rest: states with an equilibrium.
        resets: states that jump.
        breakpoints: see `ProcessModel`.
        places: see `ProcessModel`.
    """

    states: tuple[StoredVariable, ...]
    inputs: tuple[StoredVariable, ...]
    parameters: tuple[StoredVariable, ...]
    outputs: tuple[StoredOutput, ...]
    steps: tuple[Step, ...]
    results: tuple[int, ...]
    terms: tuple[str, ...] = ()
    at_rest: tuple[str, ...] = ()
    resets: tuple[str, ...] = ()
    breakpoints: tuple[str, ...] = ()
    places: tuple[Place, ...] = ()


def store_equations(model: ProcessModel) -> dict[str, Any]:
    """Convert a model to a JSON object.

    Raises:
        ValueError: an expression has a symbol that is none of the model's, or an operation on matrices.
    """
    steps, results = _to_steps(_symbols(model), model.expressions())
    stored = StoredEquations(
        states=tuple(map(_store, model.states)),
        inputs=tuple(map(_store, model.inputs)),
        parameters=tuple(map(_store, model.parameters)),
        outputs=tuple(StoredOutput(item.name, item.unit) for item in model.outputs),
        steps=steps,
        results=results,
        terms=tuple(model.terms),
        at_rest=tuple(model.at_rest),
        resets=tuple(model.resets),
        breakpoints=model.breakpoints,
        places=model.places,
    )
    found: dict[str, Any] = msgspec.to_builtins(stored)
    return found


def build_equations(name: str, stored: Mapping[str, Any]) -> ProcessModel:
    """Build a model of the name from the object of `store_equations`; its effects are the generic ones.

    Raises:
        InputError: it is no such object.
    """
    try:
        equations = msgspec.convert(stored, StoredEquations)
        for part in ("steps", "states", "inputs", "parameters", "outputs", "terms"):
            limits().check("equations", f"equations: the number of {part}", len(getattr(equations, part)))
        return _build(name, equations)
    except InputError:
        raise
    except (msgspec.ValidationError, ValueError, IndexError, KeyError) as error:
        raise InputError(f"equations: {error}; they must be as reactorwatch diagnose -o writes them") from error


def _build(name: str, stored: StoredEquations) -> ProcessModel:
    unknown = ca.SX()
    model = ProcessModel(
        name,
        tuple(map(_to_variable, stored.states)),
        tuple(map(_to_variable, stored.inputs)),
        tuple(map(_to_parameter, stored.parameters)),
        rhs=(unknown,) * len(stored.states),
        outputs=tuple(Output(item.name, item.unit, unknown) for item in stored.outputs),
        clock=new_clock(),
        terms=dict.fromkeys(stored.terms, unknown),
        at_rest=dict.fromkeys(stored.at_rest, unknown),
        resets=dict.fromkeys(stored.resets, unknown),
        breakpoints=stored.breakpoints,
        places=stored.places,
        effects=(),
    )
    needed = len(model.expressions())
    if len(stored.results) != needed:
        raise ValueError(f"results must be {needed} indices, got {len(stored.results)}")
    return model.with_expressions(_from_steps(_symbols(model), stored.steps, stored.results))


def _symbols(model: ProcessModel) -> list[ca.SX]:
    variables = [item.symbol for item in (*model.states, *model.inputs)]
    return [*variables, *(item.symbol for item in model.parameters), model.clock.now, model.clock.middle]


def _to_steps(symbols: Iterable[ca.SX], expressions: Iterable[ca.SX]) -> tuple[tuple[Step, ...], tuple[int, ...]]:
    """Steps that compute expressions of symbols, and the index of the step of each."""
    dense = [ca.densify(item) for item in expressions]
    function = ca.Function("equations", [ca.vertcat(*symbols)], [ca.vertcat(*dense)], {"allow_free": True})
    if function.has_free():
        raise ValueError(f"the equations have unknown symbols: {', '.join(map(str, function.free_sx()))}")
    steps: list[Step] = []
    results = [0] * len(dense)
    at: dict[int, int] = {}  # newest step by place of the function's memory
    for index in range(function.n_instructions()):
        code, given, into = (
            function.instruction_id(index),
            function.instruction_input(index),
            function.instruction_output(index),
        )
        if code == ca.OP_OUTPUT:
            results[into[1]] = at[given[0]]
            continue
        if code == ca.OP_CONST:
            value = function.instruction_constant(index)
            step: Step = ("const", value if isfinite(value) else repr(value))
        elif code == ca.OP_INPUT:
            step = ("symbol", given[1])
        elif code in _NAMES:
            step = (_NAMES[code], *(at[place] for place in given))
        else:
            raise ValueError(f"the equations must be of scalar operations, got CasADi's operation {code}")
        at[into[0]] = len(steps)
        steps.append(step)
    return tuple(steps), tuple(results)


def _from_steps(symbols: list[ca.SX], steps: Iterable[Step], results: Iterable[int]) -> list[ca.SX]:
    """Expressions that steps compute; an index beyond them is an IndexError."""
    values: list[ca.SX] = []
    for operation, *of in steps:
        if operation == "const":
            values.append(ca.SX(float(of[0])))
            continue
        indices = [index for index in of if isinstance(index, int) and index >= 0]
        if len(indices) != len(of) or len(of) != (2 if operation in BINARY else 1):
            raise ValueError(f"step {len(values)} must have indices of what it acts on, got {[operation, *of]}")
        if operation == "symbol":
            values.append(symbols[indices[0]])
        elif operation in UNARY:
            values.append(ca.SX.unary(_CODES[operation], values[indices[0]]))
        elif operation in BINARY:
            values.append(ca.SX.binary(_CODES[operation], values[indices[0]], values[indices[1]]))
        else:
            raise ValueError(f"step {len(values)}: unknown operation {operation!r}")
    return [values[index] for index in results]


def _store(item: Variable | Parameter) -> StoredVariable:
    facts: dict[str, Any] = {name: getattr(item, name, None) for name in ("value", "scale", "usual")}
    lower, upper = (float(bound) if isfinite(bound) else None for bound in (item.lower, item.upper))
    balance = item.balance if isinstance(item, Variable) else ""
    return StoredVariable(item.name, item.unit, item.meaning, lower, upper, balance=balance, **facts)


def _to_variable(item: StoredVariable) -> Variable:
    scale = 1.0 if item.scale is None else item.scale
    symbol = ca.SX.sym(item.name)
    return Variable(item.name, item.unit, *_bounds(item), scale, item.meaning, symbol, item.balance, item.usual)


def _to_parameter(item: StoredVariable) -> Parameter:
    value = 0.0 if item.value is None else item.value
    return Parameter(item.name, value, item.unit, *_bounds(item), item.meaning, ca.SX.sym(item.name))


def _bounds(item: StoredVariable) -> tuple[float, float]:
    return (-inf if item.lower is None else item.lower), (inf if item.upper is None else item.upper)
