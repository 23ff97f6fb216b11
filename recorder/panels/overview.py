"""Measurements, predictions and limits of each signal, with alarms and the phase plane."""

import re
from collections.abc import Mapping, Sequence

from recorder.columns.process_annotations import signal_roles, signal_title
from recorder.columns.run import RunColumns
from recorder.panels.base import (
    INPUT,
    LIMIT,
    MEASURED,
    PREDICTED,
    QUIET,
    RESIDUAL,
    SETPOINT,
    SEVERAL,
    Panel,
    Series,
    TimePlot,
    View,
    ViewReference,
)

_ROLES = ("output", "setpoint", "input", "mode", "label")
"""Roles in the order of their plots."""
BESIDE = SEVERAL[3]
"""Colour of predictions that are not those of the reference."""
_COLOURS = {"setpoint": SETPOINT, "input": INPUT, "mode": QUIET, "label": QUIET}


def draw(run: RunColumns) -> tuple[View, ...]:
    """Plots of the outputs with their set points, then of the other signals, with alarms and the phase plane."""
    units = {name: run.units.get(name, "") for name in sorted({*run.statistics, *run.samples})}
    roles = signal_roles(units, run.process)
    setpoints = _match_setpoints(roles, units)
    lone = [name for name, output in setpoints.items() if output is None]
    names = [name for role in _ROLES for name in roles if roles[name] == role and (role != "setpoint" or name in lone)]
    plots = (
        _plot(run, name, roles[name], [item for item, output in setpoints.items() if output == name]) for name in names
    )
    return (
        *filter(None, plots),
        ViewReference("Alarms", "Alarm states"),
        ViewReference("Alarms", "Alarms and faults"),
        ViewReference("Phase plane", "Around the operating branch"),
    )


def _match_setpoints(roles: Mapping[str, str], units: Mapping[str, str]) -> dict[str, str | None]:
    """Output of each set point: the only one of its unit that has its name, or its number, in common with it.

    The name of the output is part of that of the set point (`T1.sp`), or the numbers in both are equal (`SP1`), or
    there is no other output of this unit. None: there is no such output, or there are several.

    Args:
        roles: roles by signal.
        units: units by signal.
    """
    matched: dict[str, str | None] = {}
    for name in (item for item, role in roles.items() if role == "setpoint"):
        outputs = [item for item, role in roles.items() if role == "output" and units[item] == units[name]]
        named = [item for item in outputs if re.search(rf"(?<![^\W_]){re.escape(item)}(?![^\W_])", name)]
        numbered = [item for item in outputs if re.findall(r"\d+", item) == re.findall(r"\d+", name)]
        matched[name] = next((found[0] for found in (named, numbered, outputs) if len(found) == 1), None)
    return matched


def _plot(run: RunColumns, name: str, role: str, setpoints: Sequence[str]) -> TimePlot | None:
    """Plot of a signal; None if it has no samples in this segment."""
    series = [
        Series(f"set point {item}", given.time_ns, given.value, SETPOINT, held=True, legend=item)
        for item in setpoints
        if (given := run.samples.get(item)) is not None
    ]
    measured, estimated, rebuilt = run.samples.get(name), run.estimates.get(name), run.reconstructions.get(name)
    if measured is not None:
        series.append(
            Series("measured", measured.time_ns, measured.value, MEASURED, width=2.5)
            if role == "output"
            else Series("measured", measured.time_ns, measured.value, _COLOURS[role], held=True)
        )
    elif not series:
        return None
    if estimated is not None:
        # the prediction is drawn over the measurement and thinner, so that both are visible where they agree
        series = [
            Series("upper limit", estimated.time_ns, estimated.upper_limit, LIMIT, width=1.0, legend="limits"),
            Series("lower limit", estimated.time_ns, estimated.lower_limit, LIMIT, width=1.0, legend="limits"),
            *series,
            Series(
                "predicted", estimated.time_ns, estimated.prediction, PREDICTED, width=1.0, legend=_reference_label(run)
            ),
        ]
    if (beside := run.estimates_beside.get(name)) is not None:
        label = "arx, for comparison"
        series.append(Series("predicted beside", beside.time_ns, beside.prediction, BESIDE, width=0.8, legend=label))
    if rebuilt is not None:
        series.append(Series("reconstructed", rebuilt.time_ns, rebuilt.value, RESIDUAL, width=1.5))
    unit = run.units.get(name, "")
    return TimePlot(signal_title(name, unit, run.process), unit, tuple(series))


def _reference_label(run: RunColumns) -> str:
    """Legend of the predictions of the reference."""
    return f"predicted by {run.reference}" if run.reference else "predicted"


PANEL = Panel("Overview", draw, arranged="beside")
