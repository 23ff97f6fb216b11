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
(`stored_equations`), and no code is needed to read it; `effects` is then for people. `process` describes the signals,
where they are not just those of the equations: its keys are those of a process file.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from reactorwatch.errors import InputError
from reactorwatch.limits import limits, parse_json
from reactorwatch.process import EFFECTS_OF, MODELS, named_effects
from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.fault import FaultSpecification, parse_fault
from reactorwatch.process.law import ExtendedLaw, laws_of
from reactorwatch.process.model import ProcessModel, fingerprint
from reactorwatch.process.profiles import FREE_NAME, PROFILES, Profile, free_profile
from reactorwatch.process.stored_equations import build_equations, store_equations

FORMAT = "reactorwatch.model.v1"

_MINUTE_NS = 60_000_000_000
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
        model = self._build_from_catalogue() if self.equations is None else self.equations
        return replace(model, uncertain=self.uncertain) if self.uncertain else model

    def _build_from_catalogue(self) -> ProcessModel:
        nominal = {item.name: item for item in (make() for make in MODELS)}
        if self.name not in nominal:
            raise InputError(f"unknown model {self.name!r} (valid: {', '.join(nominal)})")
        try:
            return extend(nominal[self.name].with_values(self.parameters), self.effects, self.laws)
        except ValueError as error:
            raise InputError(str(error)) from error

    def rebase(self, zero_ns: int) -> "ExtendedModel":
        """Copy with minutes counted from another time; unchanged where its own zero is unknown."""
        if not self.zero_ns:
            return self
        by_min = (self.zero_ns - zero_ns) / _MINUTE_NS
        equations = None if self.equations is None else _shift(self.equations, by_min)
        effects = tuple(item.shift(by_min) for item in self.effects)
        return replace(self, effects=effects, zero_ns=zero_ns, equations=equations)

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
    if file.equations is not None:
        equations = build_equations(file.model, file.equations)
        return ExtendedModel(
            file.model, zero_ns=file.zero_ns, equations=equations, description=file.process, uncertain=file.uncertain
        )
    effects = named_effects(ExtendedModel(file.model).build())
    extended = ExtendedModel(
        file.model,
        tuple(parse_fault(item, effects).with_defaults() for item in file.effects),
        file.parameters,
        file.zero_ns,
        file.laws,
        description=file.process,
        uncertain=file.uncertain,
    )
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
    return all(
        item.effect.is_generic or any(_are_equal(item.effect, effect) for effect in own) for item in extended.effects
    )


def _are_equal(one: Effect, other: Effect) -> bool:
    return one is other or (type(one) is type(other) and vars(one) == vars(other))


def is_complete(extended: ExtendedModel, model: ProcessModel) -> bool:
    """True if the catalogue makes this very model from an extended model without equations."""
    try:
        return are_named(extended) and fingerprint(replace(extended, equations=None).build()) == fingerprint(model)
    except InputError:
        return False


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
