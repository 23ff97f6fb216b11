"""Possible range of a signal, from the bounds of the process model.

A value beyond the bounds of a state or an input, such as 9999 of a broken wire or -999 of a converter, is no
measurement. Filters, charts and the search for causes do not use it. Near a bound a sensor may read a little beyond it,
so the bounds are widened.
"""

from math import inf, isfinite
from typing import NamedTuple

from reactorwatch.process.model import ProcessModel, Variable

SENSOR_MARGIN = 0.05
"""Share of the range by which either bound is widened, for noise and bias of a sensor."""


class SignalRange(NamedTuple):
    """Possible values of a signal.

    Attributes:
        lower: smallest value.
        upper: largest value.
        unit: unit of both.
    """

    lower: float = -inf
    upper: float = inf
    unit: str = ""

    @property
    def is_bounded(self) -> bool:
        """True if the range is limited."""
        return self.lower > -inf or self.upper < inf


ANY = SignalRange()
"""Range of a signal without known bounds."""


def signal_ranges(model: ProcessModel | None, signals: tuple[str, ...]) -> list[SignalRange]:
    """Range of each signal.

    Args:
        model: model of the plant; None: ranges are unbounded.
        signals: names of the signals. An output that is not a state is unbounded.
    """
    if model is None:
        return [ANY] * len(signals)
    states = {state.name: state for state in model.states}
    variables = {variable.name: variable for variable in model.inputs}
    for output in model.outputs:
        if output.expression.is_symbolic() and output.expression.name() in states:
            variables[output.name] = states[output.expression.name()]
    return [_widen(variables[signal]) if signal in variables else ANY for signal in signals]


def _widen(variable: Variable) -> SignalRange:
    span = variable.upper - variable.lower
    margin = SENSOR_MARGIN * span if isfinite(span) else 0.0
    return SignalRange(variable.lower - margin, variable.upper + margin, variable.unit)
