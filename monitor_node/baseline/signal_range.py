"""Range of a signal: what the process cannot be, its sensor cannot measure.

A state or an input of the process model has bounds. A value beyond them, such as 9999 of a broken wire or -999 of a
converter, says nothing of the plant: it is no measurement, and enters neither filters nor charts nor the search for
causes. A sensor of a plant near a bound may show a little more than the plant is, so the bounds are widened for it.
"""

from math import inf, isfinite
from typing import NamedTuple

from reactorwatch.process.model import ProcessModel, Variable

SENSOR_MARGIN = 0.05
"""Share of the range by which its bounds are widened on either side: for the noise and the bias of a sensor."""


class SignalRange(NamedTuple):
    """Values that a signal can have.

    Attributes:
        lower: the smallest, in the unit of the model.
        upper: the largest, in the same unit.
        unit: of both.
    """

    lower: float = -inf
    upper: float = inf
    unit: str = ""

    @property
    def is_bounded(self) -> bool:
        """Whether there are values that it cannot have."""
        return self.lower > -inf or self.upper < inf


ANY = SignalRange()
"""The range of a signal of which no bounds are known."""


def ranges_of(model: ProcessModel | None, signals: tuple[str, ...]) -> list[SignalRange]:
    """The range of each signal.

    Args:
        model: of the plant; None: there is none, and nothing is known of the signals.
        signals: their names. An output has the bounds of the state that it shows; if it shows anything else, none.
    """
    if model is None:
        return [ANY] * len(signals)
    states = {state.name: state for state in model.states}
    variables = {variable.name: variable for variable in model.inputs}
    for output in model.outputs:
        if output.expression.is_symbolic() and output.expression.name() in states:
            variables[output.name] = states[output.expression.name()]
    return [_widened(variables[signal]) if signal in variables else ANY for signal in signals]


def _widened(variable: Variable) -> SignalRange:
    span = variable.upper - variable.lower
    margin = SENSOR_MARGIN * span if isfinite(span) else 0.0
    return SignalRange(variable.lower - margin, variable.upper + margin, variable.unit)
