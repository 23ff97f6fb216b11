"""Control loops of the plant: controllers of its process with their state. See `reactorwatch.process.controller`."""

from dataclasses import dataclass, replace
from math import isfinite

import casadi as ca
from msgspec.structs import replace as with_changes

from plant_node.actuators import Actuator
from reactorwatch.errors import InputError
from reactorwatch.process.controller import Controller
from reactorwatch.process.model import ProcessModel, variable


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

    def command(self, measured: float, time_min: float, dither: float) -> float:
        """Command of a row, limited to the actuator's range, from the output measured in it."""
        if self.manual is not None:
            return self.manual
        return self.actuator.limit(self._raw_command(measured, time_min, dither))

    def advance(self, measured: float, time_min: float, dither: float, period_min: float) -> "ControlLoop":
        """The loop at the next row; the integral part rests where the command is at its limit."""
        control = self.controller
        if self.manual is not None or not control.is_integral:
            return self
        deviation = measured - control.set_point_at(time_min)
        change = control.gain * deviation * period_min / control.integral_time_min
        raw = self._raw_command(measured, time_min, dither)
        actuator = self.actuator
        if (change > 0 and raw >= actuator.upper) or (change < 0 and raw <= actuator.lower):
            return self
        return replace(self, integral=self.integral + change)

    def with_set_point(self, value: float) -> "ControlLoop":
        """The loop on automatic with another set point, constant from then on."""
        return replace(self, controller=with_changes(self.controller, set_point=value), manual=None)

    def _raw_command(self, measured: float, time_min: float, dither: float) -> float:
        control = self.controller
        return control.base + dither + control.gain * (measured - control.set_point_at(time_min)) + self.integral


def check_controller(control: Controller, model: ProcessModel, actuator: Actuator | None) -> None:
    """Check a controller against a model and its actuator.

    Args:
        control: the controller.
        model: the process.
        actuator: actuator of its input; None: there is no such input.

    Raises:
        InputError: the model has no such input or output, or a set point or the base is out of range.
    """
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
    """Check the set point of an output.

    Raises:
        InputError: it is no number, or out of the bounds of the state of that name.
    """
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
    command without feedback: base and dither.

    Args:
        model: the process.
        loops: the loops.
        integral: true to add the integral parts as the last states, in the order of the loops that have them.
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
            closed = replace(
                closed,
                states=(*closed.states, state),
                rhs=(*closed.rhs, feedback / control.integral_time_min),
            )
        closed = closed.substitute(given.symbol, ca.fmin(ca.fmax(command, actuator.lower), actuator.upper))
    return closed
