"""What an effect is: a physical deviation that maps a model to a model.

An effect has a size m, whose neutral value leaves the model as it was; a profile says how m goes in time. The
extended model has the profile's numbers as further parameters, named `<effect>.size`, `<effect>.onset` and so on,
and is a `ProcessModel` like any other: what can be injected into the plant and what can be found in data are one.
"""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import ClassVar

import casadi as ca

from reactorwatch.process.model import Clock, Parameter, ProcessModel, Variable
from reactorwatch.process.profiles import CONSTANT, Profile

TIMING = "timing"
"""Location of what is wrong with the times of a record, not with the plant."""

LOCATIONS = (
    "mass_balance",
    "energy_balance",
    "reaction",
    "feed",
    "coolant",
    "temperature_sensor",
    "concentration_sensor",
    TIMING,
)
"""Where an effect on the reactor can act."""


class Effect(ABC):
    """A physical deviation.

    Attributes:
        name: as in the catalogue of causes.
        label: what a person calls it.
        location: where in the plant it acts; of the reactor's effects one of `LOCATIONS`.
        unit: of its size.
        larger: meaning of a positive size, with `{}` for its amount: in the size's unit, or in % where it is a share.
        smaller: meaning of a negative size likewise; empty where there is none.
        lower: smallest size that makes physical sense.
        upper: largest size that makes physical sense.
        neutral: the size at which it does nothing.
        typical: a size that matters in practice: fits are scaled by it.
        starts: sizes that a fit begins at, where the effect is so far from linear that it may not get there from its
            neutral size; empty: it begins at neutral.
        labels: what a person calls it with a given profile, where that has a name of its own.
        jumps: whether what it does changes with its size in jumps, so that it has no derivative.
        late_output: the output that shows by m later what was there, and that is all the effect does; None: no such.
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
    starts: ClassVar[tuple[float, ...]] = ()
    labels: ClassVar[dict[str, str]] = {}
    jumps: ClassVar[bool] = False
    late_output: ClassVar[str | None] = None

    @abstractmethod
    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """The model with the deviation in it; `size` is m(t) as an expression."""

    def extend(self, model: ProcessModel, profile: Profile = CONSTANT) -> ProcessModel:
        """The model with this effect in it.

        Args:
            model: any model that has what the effect acts on; it may hold effects already.
            profile: how the size goes in time.

        Returns:
            A model with the parameters `<name>.size` (neutral) and those of the profile, behind constants and states
            of the effect's own; when the model holds this effect already, `<name>_2.size` and so on.

        Raises:
            ValueError: the model lacks what the effect acts on.
        """
        prefix = self.prefix(model)
        size = Parameter(
            f"{prefix}.size", self.neutral, self.unit, self.lower, self.upper, f"size of: {self.label}", ca.SX.sym("m")
        )
        shape = tuple(
            Parameter(
                f"{prefix}.{item.name}",
                item.default if item.default is not None else 0.0,
                item.unit,
                item.lower,
                item.upper,
                item.meaning,
                ca.SX.sym(item.name),
            )
            for item in profile.parameters
        )
        symbols = {"size": size.symbol}
        symbols |= {item.name: new.symbol for item, new in zip(profile.parameters, shape, strict=True)}
        extended = self.apply(model, self.course(model.clock, profile, symbols))
        return replace(
            extended,
            parameters=(*extended.parameters, size, *shape),
            breakpoints=(
                *extended.breakpoints,
                *(f"{prefix}.{item.name}" for item in profile.parameters if item.breakpoint),
            ),
        )

    def course(self, clock: Clock, profile: Profile, symbols: dict[str, ca.SX]) -> ca.SX:
        """m(t) with a profile, an expression of the clock and of the symbols of its size and other numbers."""
        return profile.expression(clock, symbols)

    def label_with(self, profile: Profile) -> str:
        """What a person calls this effect with that profile."""
        return self.labels.get(profile.name, self.label)

    def prefix(self, model: ProcessModel) -> str:
        """What the names of the parameters and states begin with that this effect would bring into a model."""
        taken = set(model.parameter_names)
        prefix, number = self.name, 1
        while f"{prefix}.size" in taken:
            number += 1
            prefix = f"{self.name}_{number}"
        return prefix


class ParameterEffect(Effect):
    """An effect that multiplies one parameter of the balances by (1 + m)."""

    parameter: ClassVar[str]

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        symbol = model.parameter(self.parameter).symbol
        return model.substitute(symbol, symbol * (1 + size))


class ParameterShift(Effect):
    """An effect that adds m to one parameter of the balances."""

    parameter: ClassVar[str]

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        symbol = model.parameter(self.parameter).symbol
        return model.substitute(symbol, symbol + size)


class SensorEffect(Effect):
    """An effect on how one output is measured; the balances stay as they are."""

    output: ClassVar[str]

    @abstractmethod
    def sensed(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
        """What the sensor makes of the value that is there, and the model with what it remembers for that."""

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`.

        Raises:
            ValueError: the model has no such output.
        """
        if self.output not in model.output_names:
            raise ValueError(
                f"{self.name} needs a model with the output {self.output!r}, {model.name} has {model.output_names}"
            )
        value = model.outputs[model.output_names.index(self.output)].expression
        extended, shown = self.sensed(model, value, size)
        outputs = (replace(item, expression=shown) if item.name == self.output else item for item in model.outputs)
        return replace(extended, outputs=tuple(outputs))


class ReadingEffect(SensorEffect):
    """An effect of a sensor that remembers nothing: what it shows is a function of what is there."""

    @abstractmethod
    def measured(self, value: ca.SX, size: ca.SX) -> ca.SX:
        """What the sensor makes of the value that is there."""

    def sensed(self, model: ProcessModel, value: ca.SX, size: ca.SX) -> tuple[ProcessModel, ca.SX]:
        """See `SensorEffect`."""
        return model, self.measured(value, size)


def coolant_flow_of(effect: Effect, model: ProcessModel) -> Variable:
    """The input that the coolant valve is told.

    Raises:
        ValueError: the model has no input qc.
    """
    for item in model.inputs:
        if item.name == "qc":
            return item
    raise ValueError(f"{effect.name} needs a model with the input 'qc', {model.name} has {model.input_names}")
