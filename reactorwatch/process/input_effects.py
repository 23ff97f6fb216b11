"""Effects between the command of one input of any model and the process: gain, offset, lag, delay, stiction."""

from dataclasses import replace
from typing import ClassVar

import casadi as ca

from reactorwatch.process.effect import Effect
from reactorwatch.process.effect_states import add_delay, add_lag, window_states
from reactorwatch.process.model import ProcessModel, Variable, variable


class InputEffect(Effect):
    """An effect on one input.

    Attributes:
        input: name of the input.
    """

    input: ClassVar[str]

    def command(self, model: ProcessModel) -> Variable:
        """The input as it is commanded.

        Raises:
            ValueError: the model has no such input.
        """
        for item in model.inputs:
            if item.name == self.input:
                return item
        raise ValueError(
            f"{self.name} needs a model with the input {self.input!r}, {model.name} has {model.input_names}"
        )

    def new_state(self, model: ProcessModel) -> Variable:
        """State of the real input, in the range of its command."""
        command = self.command(model)
        bounds = (command.lower, command.upper)
        return variable(f"{self.prefix(model)}.real", command.unit, bounds, command.scale, f"real {command.meaning}")


class InputGain(InputEffect):
    """The real input is its command times (1 + m)."""

    unit = "1"
    lower = -0.99
    upper = 4.0
    typical = 0.02

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        command = self.command(model).symbol
        return model.substitute(command, command * (1 + size))


class InputOffset(InputEffect):
    """The real input is its command plus m."""

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        command = self.command(model).symbol
        return model.substitute(command, command + size)


class InputLag(InputEffect):
    """The real input follows its command with a time constant of m."""

    unit = "min"
    lower = 0.0
    upper = 10.0
    typical = 0.1
    start_values = (0.05, 0.5)

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        state, command = self.new_state(model), self.command(model).symbol
        _, real = add_lag(model, state, command, size)
        return add_lag(model.substitute(command, real), state, command, size)[0]


class InputDelay(InputEffect):
    """The real input is its command m before."""

    unit = "min"
    lower = 0.0
    upper = 3.0
    typical = 0.2
    start_values = (0.1, 0.5, 1.5)

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        command = self.command(model)
        reach = max(abs(command.lower), abs(command.upper))
        states = window_states(self.prefix(model), command.unit, reach, command.scale)
        _, real = add_delay(model, states, command.symbol, size)
        return add_delay(model.substitute(command.symbol, real), states, command.symbol, size)[0]


class InputStiction(InputEffect):
    """The real input moves only when its command is more than m away from it; then it goes to the command.

    It moves when a row begins, as the command is constant between rows. The real input is a state that jumps then and
    is constant in between. A simulation is the same for all m between two changes of the command that occur in a
    record. So its derivative with respect to m is zero, and a fit has to scan m.
    """

    lower = 0.0
    is_discontinuous = True

    def apply(self, model: ProcessModel, size: ca.SX) -> ProcessModel:
        """See `Effect`."""
        state, command = replace(self.new_state(model), scale=self.typical), self.command(model).symbol
        free = ca.logic_or(ca.fabs(command - state.symbol) > size, size <= 0)
        moved = ca.if_else(free, command, state.symbol)
        stuck = model.substitute(command, state.symbol)
        # Other states that jump at this row see the new position.
        stuck = replace(stuck, resets=model.substitute(command, moved).resets)
        return stuck.with_state(state, ca.SX(0), at_rest=command, reset=moved)
