"""Possible range of a signal, from the bounds that its process states, and from those of the process model.

A value beyond the bounds of a state or an input, such as 9999 of a broken wire or -999 of a converter, is no
measurement. Filters, charts and the search for causes do not use it. Near a bound of the model a sensor may read a
little beyond it, so the model's bounds are widened.
"""

from math import inf, isfinite
from typing import NamedTuple

from monitor_node.config import MonitorConfig
from reactorwatch.process.model import ProcessModel, Variable

SENSOR_MARGIN = 0.05
"""Share of the range by which either bound is widened, for noise and bias of a sensor."""


ROUNDING = 1e-9
"""Share of a stated range by which a value at a bound may be beyond it, as after a conversion of units."""


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


def stated_ranges(config: MonitorConfig) -> list[SignalRange]:
    """Range of each signal of a row as the settings state it, without a margin."""
    ranges = []
    for signal in config.signals:
        lower, upper = config.bounds.get(signal, (-inf, inf))
        rounding = ROUNDING * (upper - lower) if isfinite(upper - lower) else 0.0
        ranges.append(SignalRange(lower - rounding, upper + rounding, config.units.get(signal, "")))
    return ranges


def possible_ranges(config: MonitorConfig, model: ProcessModel | None) -> list[SignalRange]:
    """Range of each signal of a row: as stated, and within that of the model.

    Args:
        config: settings of the monitor.
        model: model of the plant; None: ranges are as stated.
    """
    pairs = zip(stated_ranges(config), signal_ranges(model, config.signals), strict=True)
    return [
        SignalRange(max(stated.lower, given.lower), min(stated.upper, given.upper), given.unit or stated.unit)
        for stated, given in pairs
    ]


def input_bounds(config: MonitorConfig, model: ProcessModel | None) -> list[SignalRange]:
    """Bounds at which each input is saturated: as stated, else those of the model."""
    variables = {} if model is None else {variable.name: variable for variable in model.inputs}
    bounds = []
    for name in config.inputs:
        variable = variables.get(name)
        unit = config.units.get(name, "") if variable is None else variable.unit
        if name in config.bounds:
            bounds.append(SignalRange(*config.bounds[name], unit))
        else:
            bounds.append(ANY if variable is None else SignalRange(variable.lower, variable.upper, unit))
    return bounds


def _widen(variable: Variable) -> SignalRange:
    span = variable.upper - variable.lower
    margin = SENSOR_MARGIN * span if isfinite(span) else 0.0
    return SignalRange(variable.lower - margin, variable.upper + margin, variable.unit)
