"""Check the units of a record against those of the model, for every command that reads a record.

With its inputs at their median, a plant is within a few scales of one of the model's steady states, whatever its
faults. If the record is further off, and would be near one with one of its signals multiplied by a unit conversion, the
unit is wrong, and also if a median is out of the signal's bounds. If the rows are so far apart that the process has
forgotten each before the next, or the record ends before the process has moved, its times have another unit, or it
carries no information.
"""

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.impossible_values import bounds_of
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.steady_state import SteadyState, SteadyStates

FACTORS = (60.0, 1000.0, 3600.0, 1000.0 / 60.0, 3.6, 1e6, 100.0)
"""Unit conversions of time, amounts, flows (m3/h and l/min) and fractions, in either direction."""

FAR, NEAR = 3.0, 0.7
"""Distances in scales of a state: no effect of the catalogue moves a plant beyond the first; a plant within the second
is at the steady state."""

FORGOTTEN, MOVED = 5.0, 6.0
"""Maximum row distance in slowest time constants, and minimum record length in fastest ones."""


class WrongUnit(NamedTuple):
    """A signal, or the times of a record, in another unit than the model's.

    Attributes:
        text: the rule, the value and the cure.
        of_times: true if the times are in another unit.
    """

    text: str
    of_times: bool = False


def find_wrong_unit(model: ProcessModel, columns: Mapping[str, Array], time_min: Array) -> WrongUnit | None:
    """Find the first unit of a record that is not the model's; None if there is none, or a signal is missing.

    Args:
        model: process model of the plant.
        columns: values by signal, NaN where not measured; they may differ in length.
        time_min: shape (rows,).
    """
    own = model.without_effect_states
    typical = _typical_values(own, columns)
    if typical is None or time_min.size < 2:
        return None
    u = np.array([typical[name] for name in own.input_names])
    y = np.array([typical[name] for name in own.output_names])
    when, rests, scales = float(np.median(time_min)), _steady_states(own), _scales(own)
    points = rests.at(u, when) if _possible(own, u) else []
    if points:
        nearest = min(points, key=lambda point: _distance(point, y, scales))
        if _distance(nearest, y, scales) < FAR:
            return _out_of_bounds(own, typical) or _find_wrong_time_unit(time_min, nearest)
    for index, item in enumerate(own.inputs):
        for factor in (*FACTORS, *(1.0 / factor for factor in FACTORS)):
            changed = u.copy()
            changed[index] = factor * float(u[index])
            if _possible(own, changed) and any(_distance(point, y, scales) < NEAR for point in rests.at(changed, when)):
                return WrongUnit(_describe(item.name, item.unit, float(u[index]), f"times {factor:.4g}"))
    for index, output in enumerate(own.outputs):
        for value, hint in _in_other_units(float(y[index]), output.unit):
            changed = y.copy()
            changed[index] = value
            if any(_distance(point, changed, scales) < NEAR for point in points):
                return WrongUnit(_describe(output.name, output.unit, float(y[index]), hint))
    return _out_of_bounds(own, typical)


@lru_cache(maxsize=2)
def _steady_states(model: ProcessModel) -> SteadyStates:
    """Steady states, compiled once for many records of a plant."""
    return SteadyStates(model)


def _typical_values(model: ProcessModel, columns: Mapping[str, Array]) -> dict[str, float] | None:
    """Median of each signal, without impossible values if these are few distinct ones, such as -999."""
    bounds, result = bounds_of(model), {}
    for name in (*model.input_names, *model.output_names):
        values = columns.get(name, np.empty(0))
        values = values[np.isfinite(values)]
        if not values.size:
            return None
        if name in bounds:
            possible = values[(values >= bounds[name].lower) & (values <= bounds[name].upper)]
            if 2 * np.unique(possible).size > np.unique(values).size:
                values = possible
        result[name] = float(np.median(values))
    return result


def _possible(model: ProcessModel, u: Array) -> bool:
    return all(item.lower <= value <= item.upper for item, value in zip(model.inputs, u.tolist(), strict=True))


def _out_of_bounds(model: ProcessModel, typical: Mapping[str, float]) -> WrongUnit | None:
    """First signal whose median is out of the input's or state's bounds."""
    for name, item in {item.name: item for item in (*model.inputs, *model.states)}.items():
        if name not in typical or item.lower <= typical[name] <= item.upper:
            continue
        celsius = item.unit == "K" and item.lower <= typical[name] + 273.15 <= item.upper
        hint = "is it in degrees C? then add 273.15" if celsius else "check its unit"
        rule = f"{name} must be in [{item.lower:g}, {item.upper:g}] {item.unit}"
        return WrongUnit(f"{rule}, its median is {typical[name]:g}; {hint}")
    return None


def _find_wrong_time_unit(time_min: Array, point: SteadyState) -> WrongUnit | None:
    rates = np.abs(point.eigenvalues)
    period, slowest, fastest = float(np.median(np.diff(time_min))), 1.0 / rates.min(), 1.0 / rates.max()
    span = float(time_min[-1] - time_min[0])
    cure = "check the unit of the times, which is that of the column's name, time_min or time_s"
    if period > FORGOTTEN * slowest:
        return WrongUnit(
            f"rows must be closer than {FORGOTTEN * slowest:.3g} min, they are {period:.3g} min apart, and in "
            f"between the process forgets all; {cure}, or sample faster",
            of_times=True,
        )
    if span < MOVED * fastest:
        return WrongUnit(
            f"must last at least {MOVED * fastest:.3g} min for the process to move, it lasts {span:.3g} min; {cure}, "
            "or record for longer",
            of_times=True,
        )
    return None


def _scales(model: ProcessModel) -> Array:
    """Scales of the outputs: those of their states."""
    of_states = {state.name: state.scale for state in model.states}
    return np.array([of_states.get(output.name, np.inf) for output in model.outputs])


def _distance(point: SteadyState, y: Array, scales: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):  # y may be any number
        return float(np.max(np.abs(point.outputs - y) / scales))


def _in_other_units(value: float, unit: str) -> list[tuple[float, str]]:
    result = [(factor * value, f"times {factor:.4g}") for item in FACTORS for factor in (item, 1.0 / item)]
    if unit == "K":
        result += [(value + 273.15, "taken as degrees C"), ((value + 459.67) / 1.8, "taken as degrees F")]
    return result


def _describe(signal: str, unit: str, median: float, hint: str) -> str:
    return (
        f"{signal} must be in {unit}; with its median of {median:.4g} the simulation rests nowhere near the "
        f"record, but {hint} it would; check its unit"
    )
