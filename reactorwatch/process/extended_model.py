"""A model with effects in it, as a JSON file.

    {
      "format": "reactorwatch.model.v1",
      "model": "cstr",
      "parameters": {},
      "effects": ["coolant_flow:step:-0.0498@312.33min"],
      "zero_ns": 0
    }

An effect is stored as the text that injects it into the plant as a fault (`fault`), to full precision, so a model that
is read equals the one that was written. `parameters` are those of the model that differ from its nominal values, in its
units. Laws of what was unknown (`law`) are items of a list `laws`, and what a filter of the model estimates beside its
states (`kalman.filter_states`) of a list `uncertain`; both are left out where they are empty. Times are
minutes of the record in which the deviations were found, counted from `zero_ns`, nanoseconds since 1970-01-01 UTC; 0
where that is unknown, as for a .csv.

Of a model that the catalogue lacks, the file has all `equations`, with parameters and effects in them
(`StoredEquations`), and no code is needed to read it; `effects` is then for people. `process` describes the signals,
where they are not just those of the equations: its keys are those of a process file.

All expressions of stored equations are computed by one list of steps. A step is a constant `["const", 1.5]`, a symbol
by its index among states, inputs, parameters and the two symbols of time `["symbol", 3]`, or an operation on earlier
steps by their indices `["mul", 0, 2]`. The operations are those of CasADi's scalar expressions, under CasADi's names.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import Any

import casadi as ca
import msgspec

from reactorwatch.errors import InputError
from reactorwatch.limits import limits, parse_json
from reactorwatch.process import EFFECTS_OF, MODELS, named_effects
from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.fault import FaultSpecification, parse_fault
from reactorwatch.process.law import ExtendedLaw, laws_of
from reactorwatch.process.model import Output, Parameter, Place, ProcessModel, Variable, fingerprint, new_clock
from reactorwatch.process.profiles import FREE_NAME, PROFILES, Profile, free_profile

FORMAT = "reactorwatch.model.v1"

_SIZE = re.compile(r"(.+?)(?:_\d+)?\.size")


class _ModelFile(msgspec.Struct, forbid_unknown_fields=True):
    """The JSON object, before its texts are parsed."""

    format: str
    model: str
    effects: tuple[str, ...] = ()
    parameters: dict[str, float] = {}  # msgspec copies the default
    zero_ns: int = 0
    laws: tuple[ExtendedLaw, ...] = ()
    equations: dict[str, Any] | None = None
    process: dict[str, Any] | None = None
    uncertain: tuple[str, ...] = ()


@dataclass(frozen=True)
class ExtendedModel:
    """A model with effects and changed parameters.

    Attributes:
        name: name of the model.
        effects: effects of the model in the order in which they were added; times in minutes of the record.
        parameters: values that differ from the model's nominal ones, by name, in their units.
        zero_ns: time from which the minutes are counted; 0: unknown.
        laws: laws of what was unknown, which act all the time.
        equations: the model with all of these in it, where the catalogue lacks the model; None: the catalogue has it.
        description: description of the process, as in its file (`reactorwatch.description.toml_file`); None: it has
            the signals of the equations.
        uncertain: see `ProcessModel`.
    """

    name: str
    effects: tuple[FaultSpecification, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)
    zero_ns: int = 0
    laws: tuple[ExtendedLaw, ...] = ()
    equations: ProcessModel | None = None
    description: Mapping[str, Any] | None = None
    uncertain: tuple[str, ...] = ()

    def build(self) -> ProcessModel:
        """Build the model; its clock is that of the record.

        Raises:
            InputError: there is no such model, or it cannot have these parameters or effects.
        """
        model = self.equations
        if model is None:
            nominal = {item.name: item for item in (make() for make in MODELS)}
            if self.name not in nominal:
                raise InputError(f"unknown model {self.name!r} (valid: {', '.join(nominal)})")
            try:
                model = extend(nominal[self.name].with_values(self.parameters), self.effects, self.laws)
            except ValueError as error:
                raise InputError(str(error)) from error
        return replace(model, uncertain=self.uncertain) if self.uncertain else model

    def rebase(self, zero_ns: int) -> "ExtendedModel":
        """Copy with minutes counted from another time; unchanged where its own zero is unknown."""
        if not self.zero_ns:
            return self
        return replace(self.shift((self.zero_ns - zero_ns) / 60_000_000_000), zero_ns=zero_ns)

    def shift(self, by_min: float) -> "ExtendedModel":
        """Copy with the times of its effects later."""
        equations = None if self.equations is None else _shift(self.equations, by_min)
        return replace(self, effects=tuple(item.shift(by_min) for item in self.effects), equations=equations)

    def to_object(self) -> dict[str, Any]:
        """Convert to the JSON object."""
        return {
            "format": FORMAT,
            "model": self.name,
            "parameters": dict(self.parameters),
            "effects": [str(item) for item in self.effects],
            "zero_ns": self.zero_ns,
            **({"laws": [msgspec.structs.asdict(item) for item in self.laws]} if self.laws else {}),
            **({} if self.equations is None else {"equations": store_equations(self.equations)}),
            **({} if self.description is None else {"process": dict(self.description)}),
            **({"uncertain": list(self.uncertain)} if self.uncertain else {}),
        }


def extend(
    model: ProcessModel, effects: Sequence[FaultSpecification], laws: Sequence[ExtendedLaw] = ()
) -> ProcessModel:
    """Add laws and effects to a model.

    Raises:
        ValueError: it cannot have one of them.
    """
    for law in laws:
        model = law.extend(model)
    # A timing effect shifts the times of all others, and so comes last.
    for item in sorted(effects, key=lambda item: item.effect.location == TIMING):
        model = item.extend(model)
    return model


def _shift(model: ProcessModel, by_min: float) -> ProcessModel:
    """Copy with the times of its effects later."""
    values = {item.name: item.value for item in model.parameters}
    times = [name for name in model.breakpoints if f"{name.rpartition('.')[0]}.size" in values]
    return model.with_values({name: values[name] + by_min for name in times})


def parse_extended_model(text: str | bytes) -> ExtendedModel:
    """Read the JSON that `ExtendedModel.to_object` gives.

    Raises:
        InputError: it is no such file, or a part of it is invalid.
    """
    try:
        file = msgspec.convert(parse_json(text), _ModelFile)
    except msgspec.ValidationError as error:
        raise InputError(f"is no model: {error}; it must be like extended.json of reactorwatch diagnose -o") from error
    limits().check("effects", "the number of effects and laws", len(file.effects) + len(file.laws))
    if file.format != FORMAT:
        raise InputError(f"format must be {FORMAT!r}, got {file.format!r}")
    extended = ExtendedModel(file.model, zero_ns=file.zero_ns, description=file.process, uncertain=file.uncertain)
    if file.equations is not None:
        return replace(extended, equations=build_equations(file.model, file.equations))
    known = named_effects(ExtendedModel(file.model).build())
    effects = tuple(parse_fault(item, known).with_defaults() for item in file.effects)
    extended = replace(extended, effects=effects, parameters=file.parameters, laws=file.laws)
    extended.build()  # reports invalid combinations now
    return extended


def extended_model_of(
    model: ProcessModel,
    effects: Sequence[Effect] | None = None,
    zero_ns: int = 0,
) -> ExtendedModel:
    """Recognise the effects and changed parameters of a model by its parameters.

    Args:
        model: with or without effects.
        effects: catalogue of effects; None: that of the model, and the generic ones.
        zero_ns: time from which the minutes of its effects are counted.
    """
    effects = named_effects(model) if effects is None else effects
    values = {item.name: item.value for item in model.parameters}
    found = []
    for name in values:
        match = _SIZE.fullmatch(name)
        effect = next((item for item in effects if match and item.name == match[1]), None)
        if effect is not None:
            found.append(_specification(effect, values, name.removesuffix("size")))
    nominal = next((item for item in (make() for make in MODELS) if item.name == model.name), None)
    differing = {
        item.name: values[item.name]
        for item in (nominal.parameters if nominal else ())
        if values[item.name] != item.value
    }
    return ExtendedModel(model.name, tuple(found), differing, zero_ns, laws_of(model), uncertain=model.uncertain)


def are_named(extended: ExtendedModel) -> bool:
    """True if the catalogue has the effects of an extended model, so that their names are enough."""
    own = EFFECTS_OF.get(extended.name, ())

    def is_known(effect: Effect) -> bool:
        return any(type(item) is type(effect) and vars(item) == vars(effect) for item in own)

    return all(item.effect.is_generic or is_known(item.effect) for item in extended.effects)


def is_complete(extended: ExtendedModel, model: ProcessModel) -> bool:
    """True if the catalogue makes this very model from an extended model without equations."""
    try:
        return are_named(extended) and fingerprint(replace(extended, equations=None).build()) == fingerprint(model)
    except InputError:
        return False


def stored_model(model: ProcessModel) -> ExtendedModel:
    """A model in the form that its file has: its name and effects where the catalogue makes it of them, else equations.

    Effects that are code, which could be named as causes, are in no file.
    """
    extended = extended_model_of(model)
    if is_complete(extended, model):
        return extended
    return ExtendedModel(model.name, equations=model, uncertain=model.uncertain)


def _specification(effect: Effect, values: Mapping[str, float], prefix: str) -> FaultSpecification:
    """Effect whose parameters have the prefix; profiles are distinguished by their parameters' names."""
    own = {name.removeprefix(prefix): value for name, value in values.items() if name.startswith(prefix)}
    profile = _profile({name for name in own if name != "size"})
    constants = [item.name for item in effect.constants if own[item.name] != item.value]
    return FaultSpecification(effect, profile, {name: own[name] for name in ("size", *_names(profile), *constants)})


def _profile(names: set[str]) -> Profile:
    knots = sum(name.startswith("time_") and name[5:].isdigit() for name in names)
    if knots:
        return free_profile(knots)
    fitting = [item for item in PROFILES if item.name != FREE_NAME and names >= set(_names(item))]
    return max(fitting, key=lambda item: len(item.parameters))


def _names(profile: Profile) -> tuple[str, ...]:
    return tuple(item.name for item in profile.parameters)


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
        code, given = function.instruction_id(index), function.instruction_input(index)
        into = function.instruction_output(index)
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
