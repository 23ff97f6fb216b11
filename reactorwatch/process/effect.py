"""Effects: physical deviations that map a model to a model.

An effect has a size m, whose neutral value leaves the model unchanged; a profile gives m over time. The extended model
has the profile's parameters as further parameters, named `<effect>.size`, `<effect>.onset` and so on, and is a
`ProcessModel` like any other: injected faults and diagnosed causes are the same objects.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from inspect import get_annotations
from typing import Any, ClassVar

import casadi as ca

from reactorwatch.process.model import Clock, Parameter, ProcessModel, parameter
from reactorwatch.process.profiles import CONSTANT, Profile, ProfileParameter

TIMING = "timing"
"""Location of a deviation in the timestamps of a record, not in the plant."""


@dataclass(frozen=True)
class EffectConstant:
    """A constant of an effect's own, which a record may determine beside the size.

    Attributes:
        name: name after that of the effect: `brim` of `overflow` is the parameter `overflow.brim`.
        value: nominal value, and the mean of its prior.
        sd: standard deviation of its prior.
        unit: unit of its values.
        lower: smallest value that makes physical sense.
        upper: largest value that makes physical sense.
        meaning: a short description.
        start_values: other values from which fits start.
    """

    name: str
    value: float
    sd: float
    unit: str
    lower: float
    upper: float
    meaning: str
    start_values: tuple[float, ...] = ()


class Effect(ABC):
    """A physical deviation: a class with its attributes, or a class of effects with the attributes of one of them.

    Args:
        meaning: what it does, which reports show; empty: the docstring of the class.
        **facts: attributes that the class leaves open, such as the name.

    Attributes:
        name: name in the catalogue of causes.
        label: usual name of the effect in text.
        location: part of the plant in which it acts.
        unit: unit of its size.
        larger: meaning of a positive size, with `{}` for its amount: in the size's unit, or in % for a share.
        smaller: meaning of a negative size, like `larger`; empty: there is none.
        lower: smallest size that makes physical sense.
        upper: largest size that makes physical sense.
        neutral: the size without an effect.
        typical: a size of practical significance, by which fits are scaled.
        start_values: start values of a fit, for an effect so nonlinear that a fit from its neutral size may fail;
            empty: the neutral size.
        labels: usual name with a given profile, by name of the profile, where it differs from `label`.
        is_discontinuous: whether the response jumps as the size changes, so that it has no derivative.
        delays_output: the output that the effect delays by m, if it does nothing else; None: no such effect.
        is_traced: whether the monitor compares it with others after an alarm; if not, it is left to a diagnosis.
        is_source: whether it adds an unmodelled rate to a balance, which has a location but no physical meaning.
        is_noise: whether it changes the noise of a sensor and nothing else.
        is_generic: whether it was made from a model (`generic`).
        constants: constants of its own; `add_constants` adds them to a model.

    Raises:
        TypeError: a fact is none of its attributes.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    location: ClassVar[str]
    unit: ClassVar[str]
    larger: ClassVar[str] = ""
    smaller: ClassVar[str] = ""
    lower: ClassVar[float]
    upper: ClassVar[float]
    neutral: ClassVar[float] = 0.0
    typical: ClassVar[float]
    start_values: ClassVar[tuple[float, ...]] = ()
    labels: ClassVar[dict[str, str]] = {}
    is_discontinuous: ClassVar[bool] = False
    delays_output: ClassVar[str | None] = None
    is_traced: ClassVar[bool] = True
    is_source: ClassVar[bool] = False
    is_noise: ClassVar[bool] = False
    is_generic: ClassVar[bool] = False
    constants: ClassVar[tuple[EffectConstant, ...]] = ()

    def __init__(self, meaning: str = "", /, **facts: Any) -> None:
        known = {name for kind in type(self).__mro__ for name in get_annotations(kind)}
        if unknown := facts.keys() - known:
            raise TypeError(f"{type(self).__name__} has no attribute {', '.join(sorted(unknown))}")
        vars(self).update(facts, **({"__doc__": meaning} if meaning else {}))

    @property
    def has_derivative(self) -> bool:
        """True if the innovations have a derivative by the size."""
        return not (self.is_discontinuous or self.is_noise)

    @property
    def is_share(self) -> bool:
        """True if the size is a share that is shown in per cent; one in the unit % is shown as it is."""
        return self.unit == "1" and "{} %" in self.larger

    @abstractmethod
    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """Apply the deviation; `size` is m(t) as an expression.

        Raises:
            ValueError: the model lacks what the effect acts on: a state, an input, an output, a parameter or a term.
        """

    def extend(self, model: ProcessModel, profile: Profile = CONSTANT) -> ProcessModel:
        """Add this effect to a model.

        Args:
            model: any model that has what the effect acts on; it may hold effects already.
            profile: profile of the size over time.

        Returns:
            A model with the parameters `<name>.size` (neutral) and those of the profile, after constants and states
            of the effect's own; when the model holds this effect already, `<name>_2.size` and so on.

        Raises:
            ValueError: the model lacks what the effect acts on.
        """
        prefix = self.prefix(model)
        bounds = (self.lower, self.upper)
        size = Parameter(f"{prefix}.size", self.neutral, self.unit, *bounds, f"size of: {self.label}", ca.SX.sym("m"))
        added = {"size": size} | {item.name: _shape_parameter(prefix, item) for item in profile.parameters}
        symbols = {name: item.symbol for name, item in added.items()}
        extended = self.apply(model, self.size_signal(model.clock, profile, symbols))
        jumps = (f"{prefix}.{item.name}" for item in profile.parameters if item.breakpoint)
        return replace(
            extended,
            parameters=(*extended.parameters, *added.values()),
            breakpoints=(*extended.breakpoints, *jumps),
        )

    def add_constants(self, model: ProcessModel) -> tuple[ProcessModel, tuple[ca.SX, ...]]:
        """Add the constants of this effect to a model's parameters; returns the model and their symbols."""
        prefix = self.prefix(model)
        added = tuple(
            parameter(f"{prefix}.{item.name}", item.value, item.unit, (item.lower, item.upper), item.meaning)
            for item in self.constants
        )
        return replace(model, parameters=(*model.parameters, *added)), tuple(item.symbol for item in added)

    def describe(self, size: float) -> str:
        """Meaning of a size, rounded to two digits, for people.

        Args:
            size: the size, in the effect's unit.
        """
        text, amount = self.larger or f"{self.label}: {{}} {self.unit}".removesuffix(" 1"), size
        if size < 0.0 and self.smaller:
            text, amount = self.smaller, -size
        if self.is_share:
            amount *= 100.0
        return text.format(f"{float(f'{amount:.2g}'):g}")

    def size_signal(self, clock: Clock, profile: Profile, symbols: dict[str, ca.SX]) -> ca.SX:
        """m(t) with a profile, as an expression of the clock and of the symbols of the profile's parameters."""
        return profile.expression(clock, symbols)

    def prefix(self, model: ProcessModel) -> str:
        """Prefix of the names of the parameters and states that this effect adds to a model."""
        parts = [name.split(".") for name in (*model.parameter_names, *model.state_names) if name.startswith(self.name)]
        taken = {".".join(part[:end]) for part in parts for end in range(1, len(part))}
        prefix, number = self.name, 1
        while prefix in taken:
            number += 1
            prefix = f"{self.name}_{number}"
        return prefix


def _shape_parameter(prefix: str, item: ProfileParameter) -> Parameter:
    bounds, symbol = (item.lower, item.upper), ca.SX.sym(item.name)
    return Parameter(f"{prefix}.{item.name}", item.default or 0.0, item.unit, *bounds, item.meaning, symbol)


class ParameterEffect(Effect):
    """An effect that multiplies one parameter of the balances by (1 + m), and others that have it as a factor.

    Attributes:
        parameter: name of the parameter.
        proportional: names of parameters in proportion to it.
        is_loss: whether m is the share that is lost, so that the factor is 1 - m.
    """

    unit = "1"
    lower = -0.99
    upper = 4.0
    parameter: ClassVar[str]
    proportional: ClassVar[tuple[str, ...]] = ()
    is_loss: ClassVar[bool] = False

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        for name in (self.parameter, *self.proportional):
            symbol = model.parameter(name).symbol
            model = model.substitute(symbol, self.deviate(symbol, size))
        return model

    def deviate(self, value: Any, size: Any) -> Any:
        """Value of a parameter with a deviation, as a number or an expression."""
        return value * (1 + (-size if self.is_loss else size))


class ParameterShift(Effect):
    """An effect that adds m to one parameter of the balances."""

    parameter: ClassVar[str]

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        symbol = model.parameter(self.parameter).symbol
        return model.substitute(symbol, self.deviate(symbol, size))

    def deviate(self, value: Any, size: Any) -> Any:
        """See `ParameterEffect`."""
        return value + size


class SensorEffect(Effect):
    """An effect on one sensor; the balances are unchanged.

    Attributes:
        output: name of the output that the sensor measures.
    """

    output: ClassVar[str]

    @abstractmethod
    def sense(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
        """Return the model with the states that the sensor needs, and its reading of the true value."""

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        if self.output not in model.output_names:
            raise ValueError(
                f"{self.name} needs a model with the output {self.output!r}, {model.name} has {model.output_names}"
            )
        extended, reading = self.sense(model, model.output(self.output).expression, size)
        return extended.with_output(replace(extended.output(self.output), expression=reading))
