"""Are the units of a record those of the model? What no plant does, but a wrong unit does, is told before a search.

With its inputs at their median, a plant is somewhere near one of the steady states that the model has there, whatever
is wrong with it: some scales of its states away at most. If the record is further off, and would rest at such a point
were one of its signals multiplied by what lies between two units, the unit is wrong. And a record whose rows come so
late that the process has forgotten each before the next, or which is over before the process has moved, has times in
another unit, or nothing to say.
"""

import numpy as np

from diagnosis.run import Run
from reactorwatch.errors import InputError
from reactorwatch.process.model import Array, ProcessModel
from reactorwatch.process.steady_state import SteadyState, SteadyStates

FACTORS = (60.0, 1000.0, 3600.0, 1000.0 / 60.0, 3.6, 1e6, 100.0)
"""Between units of time, of amounts, of flows (m3/h and l/min), and of shares; either way."""

FAR, NEAR = 3.0, 0.7
"""Scales of a state: so far off nothing in the catalogue moves a plant, and so near it is at its point."""

FORGOTTEN, MOVED = 5.0, 6.0
"""Time constants between two rows, and in the whole record: the slowest one, and the fastest."""


def check_units(name: str, run: Run, model: ProcessModel) -> None:
    """See the module.

    Args:
        name: of the record.
        run: of it.
        model: of the plant.

    Raises:
        InputError: a signal or the times are in another unit.
    """
    own, u = model.without_memory(), np.median(run.inputs, axis=0)
    y = np.nanmedian(run.measured, axis=0)
    when = float(np.median(run.time_min))
    rests = SteadyStates(own)
    points = rests.at(u, when)
    scales = _scales(own)
    if points:
        nearest = min(points, key=lambda point: _distance(point, y, scales))
        if _distance(nearest, y, scales) < FAR:
            _check_times(name, run, nearest)
            return
    for place, item in enumerate(own.inputs):
        for factor in (*FACTORS, *(1.0 / factor for factor in FACTORS)):
            value = factor * float(u[place])
            if item.lower <= value <= item.upper:
                changed = u.copy()
                changed[place] = value
                if any(_distance(point, y, scales) < NEAR for point in rests.at(changed, when)):
                    raise InputError(_said(name, item.name, item.unit, float(u[place]), f"times {factor:.4g}"))
    for place, output in enumerate(own.outputs):
        for value, hint in _in_other_units(float(y[place]), output.unit):
            changed = y.copy()
            changed[place] = value
            if any(_distance(point, changed, scales) < NEAR for point in points):
                raise InputError(_said(name, output.name, output.unit, float(y[place]), hint))


def _check_times(name: str, run: Run, point: SteadyState) -> None:
    rates = np.abs(point.eigenvalues)
    period, slowest, fastest = float(np.median(np.diff(run.time_min))), 1.0 / rates.min(), 1.0 / rates.max()
    cure = "check the unit of the times, which is that of the column's name, time_min or time_s"
    if period > FORGOTTEN * slowest:
        raise InputError(
            f"{name}: rows must be closer than {FORGOTTEN * slowest:.3g} min, they are {period:.3g} min apart, and in "
            f"between the process forgets all; {cure}, or sample faster"
        )
    if run.span_min < MOVED * fastest:
        raise InputError(
            f"{name}: must last at least {MOVED * fastest:.3g} min for the process to move, it lasts "
            f"{run.span_min:.3g} min; {cure}, or record for longer"
        )


def _scales(model: ProcessModel) -> Array:
    """Of the outputs: those of the states they are of."""
    of_states = {state.name: state.scale for state in model.states}
    return np.array([of_states.get(output.name, np.inf) for output in model.outputs])


def _distance(point: SteadyState, y: Array, scales: Array) -> float:
    return float(np.max(np.abs(point.outputs - y) / scales))


def _in_other_units(value: float, unit: str) -> list[tuple[float, str]]:
    found = [(factor * value, f"times {factor:.4g}") for item in FACTORS for factor in (item, 1.0 / item)]
    if unit == "K":
        found += [(value + 273.15, "taken as degrees C"), ((value + 459.67) / 1.8, "taken as degrees F")]
    return found


def _said(name: str, signal: str, unit: str, median: float, hint: str) -> str:
    return (
        f"{name}: {signal} must be in {unit}; with its median of {median:.4g} the simulation rests nowhere near the "
        f"record, but {hint} it would; check its unit"
    )
