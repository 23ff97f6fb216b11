"""A model with deviations in it, as a person can read and keep it: which model, which numbers differ, which effects.

    {
      "format": "reactorwatch.model.v1",
      "model": "cstr",
      "parameters": {},
      "effects": ["coolant_flow:step:-0.0498@312.33min"],
      "zero_ns": 0
    }

An effect is written as the same text that puts it into the plant as a fault (`fault`), to full precision, so a model
that is read is the one that was written. `parameters` are those of the model that differ from its nominal values, in
its units. Times are minutes of the record that the deviations were found in; `zero_ns` is the moment that these count
from, in nanoseconds since 1970-01-01 UTC, and 0 where nobody knows, as of a .csv.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec

from reactorwatch.errors import InputError
from reactorwatch.process import EFFECTS_OF, MODELS, effects_of
from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.fault import FaultSpecification, parse_fault
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import FREE_NAME, PROFILES, Profile, free_profile

FORMAT = "reactorwatch.model.v1"

_MINUTE_NS = 60_000_000_000
_SIZE = re.compile(r"(.+?)(?:_\d+)?\.size")


class _Written(msgspec.Struct, forbid_unknown_fields=True):
    """The object in a file, before its texts are understood."""

    format: str
    model: str
    effects: tuple[str, ...] = ()
    parameters: dict[str, float] = {}  # msgspec copies the default
    zero_ns: int = 0


@dataclass(frozen=True)
class ExtendedModel:
    """A model of the catalogue, and what is different.

    Attributes:
        name: of the model.
        effects: that are in it, in the order in which they were put in; times in minutes of the record.
        parameters: of the model that differ from its nominal values, by name, in their units.
        zero_ns: what the minutes count from; 0: not known.
    """

    name: str
    effects: tuple[FaultSpecification, ...] = ()
    parameters: Mapping[str, float] = field(default_factory=dict)
    zero_ns: int = 0

    def build(self, models: Sequence[Callable[[], ProcessModel]] = MODELS) -> ProcessModel:
        """The model itself, its clock that of the record.

        Args:
            models: the catalogue.

        Raises:
            InputError: there is no such model, or it cannot have these parameters or effects.
        """
        nominal = {item.name: item for item in (make() for make in models)}
        if self.name not in nominal:
            raise InputError(f"unknown model {self.name!r} (valid: {', '.join(nominal)})")
        try:
            model = nominal[self.name].with_values(self.parameters)
            # What is wrong with the times shifts all the others, and so comes last.
            for item in sorted(self.effects, key=lambda item: item.effect.location == TIMING):
                model = item.extend(model)
        except ValueError as error:
            raise InputError(str(error)) from error
        return model

    def counted_from(self, zero_ns: int) -> "ExtendedModel":
        """The same with its minutes counted from another moment; as it is where its own is not known."""
        if not self.zero_ns:
            return self
        by_min = (self.zero_ns - zero_ns) / _MINUTE_NS
        return replace(self, effects=tuple(item.shifted(by_min) for item in self.effects), zero_ns=zero_ns)

    def to_object(self) -> dict[str, Any]:
        """As it is written, of plain values."""
        return {
            "format": FORMAT,
            "model": self.name,
            "parameters": dict(self.parameters),
            "effects": [str(item) for item in self.effects],
            "zero_ns": self.zero_ns,
        }


def parse_extended_model(
    text: str | bytes,
    models: Sequence[Callable[[], ProcessModel]] = MODELS,
    effects: Sequence[Effect] | None = None,
) -> ExtendedModel:
    """Read what `ExtendedModel.to_object` said, as JSON.

    Args:
        text: of the file.
        models: that may be meant.
        effects: that may be in it; None: those of the model's own catalogue.

    Raises:
        InputError: it is something else, or a part of it is wrong.
    """
    try:
        written = msgspec.json.decode(text, type=_Written)
    except msgspec.ValidationError as error:
        raise InputError(f"is no model: {error}; it must be like extended.json of reactorwatch diagnose -o") from error
    except (msgspec.DecodeError, RecursionError) as error:
        raise InputError(f"is not JSON: {error}") from error
    if written.format != FORMAT:
        raise InputError(f"format must be {FORMAT!r}, got {written.format!r}")
    if effects is None:
        ExtendedModel(written.model).build(models)  # so that an unknown model is told before its effects
        effects = EFFECTS_OF.get(written.model, ())
    found = ExtendedModel(
        written.model,
        tuple(parse_fault(item, effects).settled() for item in written.effects),
        written.parameters,
        written.zero_ns,
    )
    found.build(models)  # so that what cannot be is told now
    return found


def extended_model_of(
    model: ProcessModel,
    effects: Sequence[Effect] | None = None,
    models: Sequence[Callable[[], ProcessModel]] = MODELS,
    zero_ns: int = 0,
) -> ExtendedModel:
    """What a model of the catalogue has in it by now, told from its parameters.

    Args:
        model: with or without effects.
        effects: that it may have; None: those of its own catalogue.
        models: the catalogue; of one that is not there, no parameter is taken to differ.
        zero_ns: what the minutes of its effects count from.
    """
    effects = effects_of(model) if effects is None else effects
    values = {item.name: item.value for item in model.parameters}
    found = []
    for name in values:
        said = _SIZE.fullmatch(name)
        effect = next((item for item in effects if said and item.name == said[1]), None)
        if effect is not None:
            found.append(_specification(effect, values, name.removesuffix("size")))
    nominal = next((item for item in (make() for make in models) if item.name == model.name), None)
    differing = {
        item.name: values[item.name]
        for item in (nominal.parameters if nominal else ())
        if values[item.name] != item.value
    }
    return ExtendedModel(model.name, tuple(found), differing, zero_ns)


def _specification(effect: Effect, values: Mapping[str, float], prefix: str) -> FaultSpecification:
    """An effect whose parameters begin with the prefix; profiles differ in the names of theirs."""
    own = {name.removeprefix(prefix): value for name, value in values.items() if name.startswith(prefix)}
    profile = _profile({name for name in own if name != "size"})
    return FaultSpecification(effect, profile, {name: own[name] for name in ("size", *_names(profile))})


def _profile(names: set[str]) -> Profile:
    knots = sum(name.startswith("time_") and name[5:].isdigit() for name in names)
    if knots:
        return free_profile(knots)
    fitting = [item for item in PROFILES if item.name != FREE_NAME and names >= set(_names(item))]
    return max(fitting, key=lambda item: len(item.parameters))


def _names(profile: Profile) -> tuple[str, ...]:
    return tuple(item.name for item in profile.parameters)
