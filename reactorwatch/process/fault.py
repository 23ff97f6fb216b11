"""Fault specifications: the text that injects a fault into the plant.

    coolant_flow:step:-0.05@30min
    heat_transfer:ramp:-0.3@30min,end=90min
    reaction_rate:decay:-0.2@30min,time_constant=1h
    activation_energy:constant:0.002
    coolant_flow:free:-0.05,0min=0,50min=0.2,100min=1
    side_reaction:constant:0.1,E2=12000K

The text is cause, profile and size with colons between; where the profile has an onset, `@` and the onset; then
`name=value` for the profile's other parameters, each after a comma. The size is in the effect's unit. A time carries
its unit: s, min or h. The free profile is piecewise linear: after the size come two or more `time=share of the size`.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from typing import TypeVar

from reactorwatch.errors import InputError, describe_unknown, prefix_errors
from reactorwatch.process.effect import Effect, EffectConstant
from reactorwatch.process.library.cstr import EFFECTS
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.profiles import FREE_NAME, PROFILES, Profile, ProfileParameter, free_profile

EXAMPLE = "coolant_flow:step:-0.05@30min"

_MINUTES = {"s": 1 / 60, "min": 1.0, "h": 60.0}
_NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*)")

_Item = TypeVar("_Item")


@dataclass(frozen=True)
class FaultSpecification:
    """An effect, its profile and its size.

    Attributes:
        effect: effect of the catalogue.
        profile: profile of the catalogue.
        values: `size`, the given parameters of the profile, times in minutes of the plant, and the given constants of
            the effect's own.
    """

    effect: Effect
    profile: Profile
    values: Mapping[str, float]

    def with_defaults(self, onset_min: float = 0.0, end_min: float | None = None) -> "FaultSpecification":
        """Copy with every parameter of its profile.

        Args:
            onset_min: default onset.
            end_min: end of the run, the default end of a ramp; None: unknown.

        Raises:
            InputError: a ramp that has no end in a run that has none, or that ends before it begins.
        """
        values = {"size": self.values["size"]}
        for item in self.profile.parameters:
            default = {"onset": onset_min, "end": end_min}.get(item.name, item.default)
            value = self.values.get(item.name, default)
            if value is None:
                raise InputError(
                    f"fault {str(self)!r}: {item.name} ({item.meaning}) must be given where the run has no end, "
                    f"like ,{item.name}=90min; or give the run a duration"
                )
            values[item.name] = value
        values |= {item.name: self.values[item.name] for item in self.effect.constants if item.name in self.values}
        with prefix_errors(f"fault {str(self)!r}"):
            _check_order(values)
        return FaultSpecification(self.effect, self.profile, values)

    def extend(self, model: ProcessModel, end_min: float | None = None) -> ProcessModel:
        """Add this fault to a model; the default onset is 0.

        Args:
            model: any that has what the effect acts on.
            end_min: end of the run, see `with_defaults`.

        Raises:
            InputError: as `with_defaults`.
            ValueError: the model lacks what the effect acts on.
        """
        values = self.with_defaults(end_min=end_min).values
        extended = self.effect.extend(model, self.profile)
        before = set(model.parameter_names)
        new = [name for name in extended.parameter_names if name not in before]
        prefix = next(name for name in new if name.endswith(".size")).removesuffix("size")
        return extended.with_values({f"{prefix}{name}": value for name, value in values.items()})

    def shift(self, by_min: float) -> "FaultSpecification":
        """Copy with all times later."""
        times = {item.name for item in self.profile.parameters if item.breakpoint}
        values = {name: value + by_min if name in times else value for name, value in self.values.items()}
        return FaultSpecification(self.effect, self.profile, values)

    def __str__(self) -> str:
        """The canonical text, which `parse_fault` reads."""
        text = f"{self.effect.name}:{self.profile.name}:{_format(self.values['size'])}"
        given = [item for item in self.effect.constants if item.name in self.values]
        constants = "".join(f",{item.name}={_format(self.values[item.name])}" for item in given)
        if self.profile.name == FREE_NAME:
            return (
                text
                + constants
                + "".join(f",{_format(time)}min={_format(share)}" for time, share in _curve(self.values))
            )
        if "onset" in self.values:
            text += f"@{_format(self.values['onset'])}min"
        for item in self.profile.parameters:
            if item.name in self.values and item.name != "onset":
                text += f",{item.name}={_format(self.values[item.name])}{'min' if item.unit == 'min' else ''}"
        return text + constants


def parse_fault(text: str, effects: Sequence[Effect] = EFFECTS) -> FaultSpecification:
    """Read a fault specification.

    >>> str(parse_fault("coolant_flow:step:-0.05@1800s"))
    'coolant_flow:step:-0.05@30min'

    Args:
        text: the specification, like `EXAMPLE`.
        effects: catalogue of causes.

    Raises:
        InputError: a part of it is invalid; the message names the part, the rule and the value.
    """
    with prefix_errors(f"fault {text!r}"):
        return _parse(text, effects)


def _parse(text: str, effects: Sequence[Effect]) -> FaultSpecification:
    parts = [part.strip() for part in text.split(":")]
    if len(parts) != 3:
        raise InputError(f"must be cause:profile:size[@onset][,name=value]..., like {EXAMPLE}")
    effect = _look_up("cause", parts[0], {item.name: item for item in effects})
    profile = _look_up("profile", parts[1], {item.name: item for item in PROFILES})
    first, *assignments = (part.strip() for part in parts[2].split(","))
    size, at, onset = (part.strip() for part in first.partition("@"))
    known: dict[str, ProfileParameter | EffectConstant] = {item.name: item for item in profile.parameters}
    constants = {item.name: item for item in effect.constants}
    if at and "onset" not in known:
        raise InputError(f"the profile {profile.name} has no onset, got '@{onset}'; leave it out")
    values = {"size": _parse_number("size", size, effect.unit, (effect.lower, effect.upper))}
    if profile.name == FREE_NAME:
        named = [item for item in assignments if item.partition("=")[0].strip() in constants]
        assignments = [item for item in assignments if item not in named]
        shape, values = _parse_curve(effect, values["size"], assignments)
        assignments, profile, known = named, shape, {}
    known |= constants
    what = f"parameter of the profile {profile.name}" + (f" or constant of {effect.name}" if constants else "")
    given = [("onset", onset)] if at else []
    for assignment in assignments:
        name, equals, value = (part.strip() for part in assignment.partition("="))
        if not equals:
            raise InputError(f"after the size must come name=value, got {assignment!r}")
        given.append((name, value))
    for name, value in given:
        item = _look_up(what, name, known)
        if name in values:
            raise InputError(f"{name} must be given once, got it again as {value!r}")
        values[name] = _parse_number(name, value, item.unit, (item.lower, item.upper))
    _check_order(values)
    return FaultSpecification(effect, profile, values)


def _parse_curve(effect: Effect, size: float, assignments: list[str]) -> tuple[Profile, dict[str, float]]:
    """Read the knots of a free profile."""
    knots: list[tuple[float, float]] = []
    for assignment in assignments:
        written, _, fraction = (part.strip() for part in assignment.partition("="))
        time = _parse_number("time", written, "min", (-inf, inf))
        share = _parse_number("share", fraction, "1", (-inf, inf))
        if knots and not knots[-1][0] < time:
            raise InputError(f"times must rise, got {time:g} min after {knots[-1][0]:g} min")
        value, reach = size * share, f"[{effect.lower:g}, {effect.upper:g}]"
        if not effect.lower <= value <= effect.upper:
            raise InputError(f"size times share must be in {reach}, got {value:g} at {time:g} min")
        knots.append((time, share))
    if not 2 <= len(knots) <= 100:  # every step of the plant searches them
        raise InputError(f"a curve must have 2 to 100 times with their shares, like ,0min=0,90min=1, got {len(knots)}")
    values = {"size": size}
    values |= {f"time_{number}": time for number, (time, _) in enumerate(knots, 1)}
    values |= {f"value_{number}": share for number, (_, share) in enumerate(knots, 1)}
    return free_profile(len(knots)), values


def _curve(values: Mapping[str, float]) -> list[tuple[float, float]]:
    """Knots of a free profile: times in minutes and shares of the size."""
    count = sum(name.startswith("time_") for name in values)
    return [(values[f"time_{number}"], values[f"value_{number}"]) for number in range(1, count + 1)]


def _look_up(what: str, name: str, valid: Mapping[str, _Item]) -> _Item:
    if name not in valid:
        raise InputError(describe_unknown(what, name, valid))
    return valid[name]


def _parse_number(name: str, written: str, unit: str, bounds: tuple[float, float]) -> float:
    """Parse a number with its unit and convert it to the stored unit."""
    in_unit = "" if unit == "1" else f" {unit}"
    if unit == "min":
        factors, rule = dict(_MINUTES), f"a time with its unit ({', '.join(_MINUTES)}), like 30min"
    else:
        factors, rule = {unit: 1.0, "": 1.0}, f"a number{in_unit and ' in' + in_unit}"
    if name == "size":
        factors[""] = 1.0
    match = _NUMBER.fullmatch(written)
    if match is None or match[2] not in factors:
        raise InputError(f"{name} must be {rule}, got {written!r}")
    value = float(match[1]) * factors[match[2]]
    if not (bounds[0] <= value <= bounds[1] and isfinite(value)):
        raise InputError(f"{name} must be in [{bounds[0]:g}, {bounds[1]:g}]{in_unit}, got {value:g}")
    return value


def _check_order(values: Mapping[str, float]) -> None:
    if "onset" in values and "end" in values and not values["onset"] < values["end"]:
        raise InputError(
            f"end must come after the onset, got end {values['end']:g} min and onset {values['onset']:g} min"
        )


def _format(value: float) -> str:
    return repr(value).removesuffix(".0")
