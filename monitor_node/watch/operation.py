"""Operation of a plant beside its measurements: saturated inputs, modes and set points, which go with an alarm.

An alarm has other reasons where a pump runs at its limit, a controller is in manual, or a set point has just moved. The
monitor raises the alarm all the same, and its text states them.

Samples of modes and set points come at times of their own, often only when they change. They make no rows.
"""

from collections.abc import Mapping, Sequence
from math import isfinite, nan

import msgspec

from monitor_node.config import MonitorConfig
from monitor_node.watched_process import SignalRange
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.spc.charts.base import format_quantity

RAMP_MIN = 1.0
"""Longest pause within one move of a set point that is moved in steps."""


class CarriedState(msgspec.Struct, forbid_unknown_fields=True):
    """State of a mode or a set point.

    Attributes:
        value: newest value; NaN before the first.
        time_ns: time of its newest sample.
        before: value before its newest move; NaN before the first move.
        moved_ns: start of that move.
        changed_ns: newest change.
        usual: value at the end of the training; NaN if there was none.
    """

    value: float = nan
    time_ns: int = -(2**63)
    before: float = nan
    moved_ns: int = 0
    changed_ns: int = 0
    usual: float = nan


class Operation:
    """Follows the operation of one plant.

    Attributes:
        memory: states of modes and set points, by signal.
    """

    def __init__(self, config: MonitorConfig, bounds: Sequence[SignalRange], units: Mapping[str, str]) -> None:
        self._config, self._units = config, units
        self._bounds = list(zip(config.inputs, bounds, strict=True))
        self.inputs: Sequence[float] = ()
        """Inputs of the row that is being evaluated; empty between rows."""
        self.memory = {name: CarriedState() for name in config.carried_signals}

    def on_sample(self, signal: str, time_ns: int, value: float) -> None:
        """Process a sample of a mode or a set point; one that is not newer than the newest is ignored."""
        state = self.memory[signal]
        if time_ns <= state.time_ns:
            return
        state.time_ns = time_ns
        if value == state.value:
            return
        if state.value == state.value:  # NaN is not equal to itself
            is_same_move = state.before == state.before and time_ns - state.changed_ns <= RAMP_MIN * MINUTE_NS
            if not is_same_move:
                state.before, state.moved_ns = state.value, time_ns
            state.changed_ns = time_ns
        state.value = value

    @property
    def values(self) -> dict[str, float]:
        """Newest value of each mode and set point; NaN before the first."""
        return {name: state.value for name, state in self.memory.items()}

    def on_restart(self) -> None:
        """Forget times: the plant's clock was set back, or the plant was restarted."""
        for name, state in self.memory.items():
            self.memory[name] = CarriedState(state.value, usual=state.usual)

    def end_training(self) -> None:
        """Take the present modes as the usual ones."""
        for state in self.memory.values():
            state.usual = state.value

    def describe(self, time_ns: int) -> str:
        """Saturated inputs, unusual modes and recent moves of set points, as the text of an alarm has them."""
        pairs = zip(self._bounds, self.inputs, strict=False)
        parts = [_describe_saturation(name, bounds, value) for (name, bounds), value in pairs]
        parts += [self._describe_mode(name) for name in self._config.modes]
        parts += [self._describe_move(name, time_ns) for name in self._config.setpoints]
        return "; ".join(filter(None, parts))

    def _describe_mode(self, name: str) -> str:
        state = self.memory[name]
        if state.value == state.usual or state.usual != state.usual:
            return ""
        return f"{name} is {state.value:.6g}, and was {state.usual:.6g} at the end of the training"

    def _describe_move(self, name: str, time_ns: int) -> str:
        state = self.memory[name]
        if state.before != state.before or time_ns - state.changed_ns > self._config.incident_min * MINUTE_NS:
            return ""
        now, minutes = (
            format_quantity(state.value, self._units.get(name, ""), ".6g"),
            (time_ns - state.moved_ns) / MINUTE_NS,
        )
        return f"{name} moved from {state.before:.6g} to {now}, from {max(minutes, 0.0):.3g} min before on"


def _describe_saturation(name: str, bounds: SignalRange, value: float) -> str:
    span = bounds.upper - bounds.lower
    margin = 1e-6 * span if isfinite(span) else 0.0
    for side, bound in (("lower", bounds.lower), ("upper", bounds.upper)):
        if abs(value - bound) <= margin:
            return f"{name} is at its {side} bound, {format_quantity(bound, bounds.unit, '.6g')}"
    return ""
