"""Instruments of the plant: noise, sensors, actuators and control loops, and the process noise of its states.

The random number of row k is a function of (seed, stream, k), drawn in blocks with a generator each. So it depends
neither on the first row of a run nor on any other stream: without noise in C, that in T is the same to the last bit.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from math import hypot, isfinite, sqrt

import casadi as ca
import numpy as np
from msgspec.structs import replace as with_changes
from numpy.typing import NDArray

from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel, Variable, variable
from reactorwatch.process.operation import Controller

BLOCK = 1024  # rows


def standard_normal(seed: int, stream: str, row: int) -> float:
    """Draw a standard normal number, a deterministic function of the arguments."""
    return float(_block(seed, stream, row // BLOCK)[row % BLOCK])


@lru_cache(maxsize=32)
def _block(seed: int, stream: str, block: int) -> NDArray[np.float64]:
    sequence = np.random.SeedSequence([seed, int.from_bytes(stream.encode()), block])
    return np.random.default_rng(sequence).standard_normal(BLOCK)


@dataclass(frozen=True)
class Actuator:
    """An actuator, such as a valve or a pump, whose input is its command, limited to its range.

    Attributes:
        lower: smallest input, in its unit.
        upper: largest input.
    """

    lower: float
    upper: float

    def limit(self, command: float) -> float:
        """The input at a command."""
        return min(max(command, self.lower), self.upper)

    def reaches(self, command: float) -> bool:
        """True if a command is within the range."""
        return self.lower <= command <= self.upper


@dataclass(frozen=True)
class Sensor:
    """Measures one signal.

    Attributes:
        signal: name of the signal.
        noise_sd: standard deviation of the white normal noise, in the signal's unit.
        resolution: quantisation step, in the signal's unit; 0: none.
        seed: seed of the noise.
    """

    signal: str
    noise_sd: float
    resolution: float
    seed: int

    def reading(self, value: float, row: int, beyond: float = 0.0) -> float:
        """Reading of a value in a row of the run; `beyond` is the variance of the noise beyond the sensor's own."""
        if self.noise_sd or beyond:
            sd = hypot(self.noise_sd, sqrt(beyond)) if beyond else self.noise_sd
            value += sd * standard_normal(self.seed, f"sensor {self.signal}", row)
        if self.resolution:
            value = round(value / self.resolution) * self.resolution
        return value


@dataclass(frozen=True)
class ProcessNoise:
    """Process noise of one state.

    Attributes:
        state: the state; the noise does not move it beyond its bounds.
        sd: standard deviation of the noise of a row, in the state's unit.
        seed: seed of the noise.
    """

    state: Variable
    sd: float
    seed: int

    def add_to(self, value: float, row: int) -> float:
        """Add the noise of a row to the integrated value of the state."""
        state, increment = self.state, self.sd * standard_normal(self.seed, f"process {self.state.name}", row)
        # A state that the equations took beyond its bounds is not pulled back: that would not be noise.
        return min(max(value + increment, min(state.lower, value)), max(state.upper, value))


@dataclass(frozen=True)
class ControlLoop:
    """A controller with its state; the state of a row follows from that of the row before.

    Attributes:
        controller: the controller.
        actuator: actuator of its input.
        integral: integral part of the command, in the input's unit.
        manual: command in place of the controller's; None: automatic.
    """

    controller: Controller
    actuator: Actuator
    integral: float = 0.0
    manual: float | None = None

    def step(self, measured: float, time_min: float, dither: float, period_min: float) -> tuple[float, "ControlLoop"]:
        """Command of a row from the output measured in it, within the actuator's range, and the loop at the next row.

        The integral part rests where the command is at its limit.
        """
        if self.manual is not None:
            return self.manual, self
        control, actuator = self.controller, self.actuator
        deviation = measured - control.set_point_at(time_min)
        raw = control.base + dither + control.gain * deviation + self.integral
        if not control.is_integral:
            return actuator.limit(raw), self
        change = control.gain * deviation * period_min / control.integral_time_min
        if (change > 0 and raw >= actuator.upper) or (change < 0 and raw <= actuator.lower):
            return actuator.limit(raw), self
        return actuator.limit(raw), replace(self, integral=self.integral + change)

    def with_set_point(self, value: float) -> "ControlLoop":
        """The loop on automatic with another set point, constant from then on."""
        return replace(self, controller=with_changes(self.controller, set_point=value), manual=None)


def check_controller(control: Controller, model: ProcessModel, actuator: Actuator | None) -> None:
    """Check a controller against a model and the actuator of its input, None if the model has no such input."""
    if actuator is None or control.output not in model.output_names:
        needed = ("input", control.input) if actuator is None else ("output", control.output)
        got = model.input_names if actuator is None else model.output_names
        name = f"controller of {control.input!r}"
        raise InputError(f"{name} needs a model with the {needed[0]} {needed[1]!r}, {model.name} has {got}")
    if not actuator.reaches(control.base):
        unit = model.units[control.input]
        raise InputError(
            f"controller of {control.input!r}: base must be in [{actuator.lower:g}, {actuator.upper:g}] {unit}, "
            f"got {control.base:g}"
        )
    for _, value in control.steps:
        check_set_point(model, control.output, value)


def check_set_point(model: ProcessModel, output: str, value: float) -> None:
    """Check that the set point of an output is a number, within the bounds of the state of that name."""
    state = next((item for item in model.states if item.name == output), None)
    if state is None and not isfinite(value):
        raise InputError(f"set point of {output} must be a finite number, got {value:g}")
    if state is not None and not state.lower <= value <= state.upper:
        raise InputError(
            f"set point of {output} must be in [{state.lower:g}, {state.upper:g}] {state.unit}, got {value:g}"
        )


def close_loops(model: ProcessModel, loops: tuple[ControlLoop, ...], *, integral: bool) -> ProcessModel:
    """Model of the closed loops in continuous time, at the set points of plant time 0.

    It has the steady state of the sampled loops, which is its purpose, but other transients. A controlled input is its
    command without feedback: base and dither. `integral` adds the integral parts as the last states, in the order of
    the loops that have them.
    """
    closed = model
    for loop in loops:
        control, actuator = loop.controller, loop.actuator
        given = model.inputs[model.input_names.index(control.input)]
        measured = model.outputs[model.output_names.index(control.output)].expression
        feedback = control.gain * (measured - control.set_point_at(0.0))
        command = given.symbol + feedback
        if integral and control.is_integral:
            span = actuator.upper - actuator.lower
            state = variable(f"integral {given.name}", given.unit, (-span, span), given.scale, "integral part")
            command += state.symbol
            rhs = (*closed.rhs, feedback / control.integral_time_min)
            closed = replace(closed, states=(*closed.states, state), rhs=rhs)
        closed = closed.substitute(given.symbol, ca.fmin(ca.fmax(command, actuator.lower), actuator.upper))
    return closed
