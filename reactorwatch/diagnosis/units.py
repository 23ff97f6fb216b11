"""Units of a record against those of the model: one check, for every command that reads a record.

With its inputs at their median, a plant is somewhere near one of the steady states that the model has there, whatever
is wrong with it: some scales of its states away at most. If the record is further off, and would rest at such a point
were one of its signals multiplied by what lies between two units, the unit is wrong; or where a median is no value that
the signal can have. And a record whose rows come so late that the process has forgotten each before the next, or which
is over before the process has moved, has times in another unit, or nothing to say.
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
"""Between units of time, of amounts, of flows (m3/h and l/min), and of shares; either way."""

FAR, NEAR = 3.0, 0.7
"""Scales of a state: so far off nothing in the catalogue moves a plant, and so near it is at its point."""

FORGOTTEN, MOVED = 5.0, 6.0
"""Time constants between two rows, and in the whole record: the slowest one, and the fastest."""


class WrongUnit(NamedTuple):
    """A signal, or the times of a record, in another unit than the model's.

    Attributes:
        text: the rule, what was found, and the cure.
        of_times: whether it is the times that are in another unit.
    """

    text: str
    of_times: bool = False


def find_wrong_unit(model: ProcessModel, columns: Mapping[str, Array], time_min: Array) -> WrongUnit | None:
    """The first unit of a record that is not the model's; None if there is none, or a signal is not in the record.

    Args:
        model: of the plant.
        columns: values by signal, NaN where not measured; they may differ in length.
        time_min: shape (rows,).
    """
    own = model.without_effect_states()
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
            return _out_of_bounds(own, typical) or _wrong_times(time_min, nearest)
    for place, item in enumerate(own.inputs):
        for factor in (*FACTORS, *(1.0 / factor for factor in FACTORS)):
            changed = u.copy()
            changed[place] = factor * float(u[place])
            if _possible(own, changed) and any(_distance(point, y, scales) < NEAR for point in rests.at(changed, when)):
                return WrongUnit(_said(item.name, item.unit, float(u[place]), f"times {factor:.4g}"))
    for place, output in enumerate(own.outputs):
        for value, hint in _in_other_units(float(y[place]), output.unit):
            changed = y.copy()
            changed[place] = value
            if any(_distance(point, changed, scales) < NEAR for point in points):
                return WrongUnit(_said(output.name, output.unit, float(y[place]), hint))
    return _out_of_bounds(own, typical)


@lru_cache(maxsize=2)
def _steady_states(model: ProcessModel) -> SteadyStates:
    """Compiled once for many records of a plant."""
    return SteadyStates(model)


def _typical_values(model: ProcessModel, columns: Mapping[str, Array]) -> dict[str, float] | None:
    """Median of each signal, without values that it cannot have if these are few different ones, such as -999."""
    bounds, found = bounds_of(model), {}
    for name in (*model.input_names, *model.output_names):
        values = columns.get(name, np.empty(0))
        values = values[np.isfinite(values)]
        if not values.size:
            return None
        if name in bounds:
            possible = values[(values >= bounds[name].lower) & (values <= bounds[name].upper)]
            if 2 * np.unique(possible).size > np.unique(values).size:
                values = possible
        found[name] = float(np.median(values))
    return found


def _possible(model: ProcessModel, u: Array) -> bool:
    return all(item.lower <= value <= item.upper for item, value in zip(model.inputs, u.tolist(), strict=True))


def _out_of_bounds(model: ProcessModel, typical: Mapping[str, float]) -> WrongUnit | None:
    """The first signal whose median is no value that the input or state can have."""
    for name, item in {item.name: item for item in (*model.inputs, *model.states)}.items():
        if name not in typical or item.lower <= typical[name] <= item.upper:
            continue
        celsius = item.unit == "K" and item.lower <= typical[name] + 273.15 <= item.upper
        hint = "is it in degrees C? then add 273.15" if celsius else "check its unit"
        rule = f"{name} must be in [{item.lower:g}, {item.upper:g}] {item.unit}"
        return WrongUnit(f"{rule}, its median is {typical[name]:g}; {hint}")
    return None


def _wrong_times(time_min: Array, point: SteadyState) -> WrongUnit | None:
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
    """Of the outputs: those of the states they are of."""
    of_states = {state.name: state.scale for state in model.states}
    return np.array([of_states.get(output.name, np.inf) for output in model.outputs])


def _distance(point: SteadyState, y: Array, scales: Array) -> float:
    with np.errstate(over="ignore", invalid="ignore"):  # y may be any number
        return float(np.max(np.abs(point.outputs - y) / scales))


def _in_other_units(value: float, unit: str) -> list[tuple[float, str]]:
    found = [(factor * value, f"times {factor:.4g}") for item in FACTORS for factor in (item, 1.0 / item)]
    if unit == "K":
        found += [(value + 273.15, "taken as degrees C"), ((value + 459.67) / 1.8, "taken as degrees F")]
    return found


def _said(signal: str, unit: str, median: float, hint: str) -> str:
    return (
        f"{signal} must be in {unit}; with its median of {median:.4g} the simulation rests nowhere near the "
        f"record, but {hint} it would; check its unit"
    )
