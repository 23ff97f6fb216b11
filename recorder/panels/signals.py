"""Measurements with their predictions and limits, residuals with their control charts, and models: three panels.

The panel of models shows the parameters of the adaptive, frozen and reference model, noise levels, and excitation: the
ratio of the smallest to the largest singular value of the scaled regressor. Where it is near 0, the estimated
parameters are noise.

Signals have meanings and roles from their process, or from the catalogue of processes.
"""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.description.process import Process
from reactorwatch.process import MODELS as PROCESS_MODELS
from reactorwatch.process.model import ProcessModel
from recorder.columns import (
    ADAPTIVE,
    EQUATIONS,
    FROZEN,
    REFERENCE,
    ChartColumns,
    EstimateColumns,
    RunColumns,
    Times,
    Values,
    times_of,
)
from recorder.panels.base import (
    ALARM,
    INPUT,
    LIMIT,
    MEASURED,
    PREDICTED,
    QUIET,
    RESIDUAL,
    SETPOINT,
    SEVERAL,
    Colour,
    Panel,
    Series,
    TimePlot,
    View,
    ViewReference,
)

_ROLES = ("output", "setpoint", "input", "mode", "label")
"""Roles in the order of their plots."""
_ROLE_COLOURS = {"setpoint": SETPOINT, "input": INPUT, "mode": QUIET, "label": QUIET}


def signal_title(name: str, unit: str, process: Process | None = None) -> str:
    """Name of a signal, with its meaning if its process has a variable of that name.

    Without a process, it is any of the catalogue whose variable has this unit, too.
    """
    for model in _models_of(process):
        for item in (*model.inputs, *model.states):
            if item.name == name and (item.unit == unit or process is not None):
                return f"{name}: {item.meaning}" if item.meaning else name
    return name


def signal_roles(units: Mapping[str, str], process: Process | None = None) -> dict[str, str]:
    """Roles of signals by name: those of the process in its order, then all others as outputs.

    Args:
        units: units of the signals, by name; empty: unknown.
        process: process of the signals; None: the one of the catalogue that has all of them, or all of whose signals
            are there.
    """
    if process is not None:
        roles = {signal.name: signal.role for signal in process.signals}
    elif (model := find_model(units) or _find_model_with(units)) is not None:
        roles = {name: "input" if name in model.input_names else "output" for name in model.units}
    else:
        roles = {}
    known = {name: role for name, role in roles.items() if name in units}
    return known | {name: "output" for name in units if name not in roles}


def find_model(units: Mapping[str, str], process: Process | None = None) -> ProcessModel | None:
    """Equations, of the catalogue without a process, whose inputs and outputs are all present with the same units."""
    return next((model for model in _models_of(process) if model.units.items() <= units.items()), None)


def _find_model_with(units: Mapping[str, str]) -> ProcessModel | None:
    """Model of the catalogue that has all of the signals, none of them in another unit."""
    for model in _models():
        if all(name in model.units and unit in ("", model.units[name]) for name, unit in units.items()):
            return model
    return None


def _models_of(process: Process | None) -> tuple[ProcessModel, ...]:
    """Equations of a process; without its own, those of the catalogue under its name."""
    if process is None:
        return _models()
    if process.model is not None:
        return (process.model,)
    return tuple(model for model in _models() if model.name == process.name)


@cache
def _models() -> tuple[ProcessModel, ...]:
    return tuple(build() for build in PROCESS_MODELS)


def draw_overview(run: RunColumns) -> tuple[View, ...]:
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
        style = (MEASURED, 2.5, False) if role == "output" else (_ROLE_COLOURS[role], 1.5, True)
        series.append(Series("measured", measured.time_ns, measured.value, *style))
    elif not series:
        return None
    if estimated is not None:
        # the prediction is drawn over the measurement and thinner, so that both are visible where they agree
        label = f"predicted by {run.reference}" if run.reference else "predicted"
        series = [
            *_limits(estimated.time_ns, estimated.lower_limit, estimated.upper_limit),
            *series,
            Series("predicted", estimated.time_ns, estimated.prediction, PREDICTED, width=1.0, legend=label),
        ]
    if (beside := run.estimates_beside.get(name)) is not None:
        label = "arx, for comparison"
        series.append(Series("predicted beside", beside.time_ns, beside.prediction, RESIDUAL, width=0.8, legend=label))
    if rebuilt is not None:
        series.append(Series("reconstructed", rebuilt.time_ns, rebuilt.value, RESIDUAL, width=1.5))
    unit = run.units.get(name, "")
    return TimePlot(signal_title(name, unit, run.process), unit, tuple(series))


def _limits(time_ns: Times, lower: Values, upper: Values) -> tuple[Series, Series]:
    return (
        Series("upper limit", time_ns, upper, LIMIT, width=1.0, legend="limits"),
        Series("lower limit", time_ns, lower, LIMIT, width=1.0, legend="limits"),
    )


OVERVIEW = Panel("Overview", draw_overview, arranged="beside")


def draw_charts(run: RunColumns) -> tuple[TimePlot, ...]:
    """Plots of the residual of each predicted signal and of each chart, multivariate charts last."""
    residuals = [_residual(name, run.units.get(name, ""), item) for name, item in sorted(run.estimates.items())]
    names = sorted(run.charts, key=lambda name: (name.endswith("/all"), name))
    return (*residuals, *(_chart(name, run.charts[name]) for name in names))


def _residual(name: str, unit: str, estimated: EstimateColumns) -> TimePlot:
    """Plot of a residual, whose initial range is that of residuals and limits from the first limits on.

    Early in the training residuals are large; on their scale nothing later would be visible.
    """
    time_ns, residual, (lower, upper) = estimated.time_ns, estimated.residual, estimated.residual_limits
    watched = np.isfinite(lower) & np.isfinite(upper) & np.isfinite(residual)
    shown = _with_margin(np.concatenate([lower[watched], upper[watched], residual[watched]]))
    series = (*_limits(time_ns, lower, upper), Series("measured - predicted", time_ns, residual, RESIDUAL))
    return TimePlot(f"Residual of {name}", unit, series, shown)


def _chart(name: str, chart: ChartColumns) -> TimePlot:
    distance = np.maximum(np.abs(chart.upper_limit - chart.centre), np.abs(chart.lower_limit - chart.centre))
    # a statistic 25 distances of the limit away is at the edge of the plot: beyond it the limits would be invisible
    highest, lowest = chart.centre + 25.0 * distance, chart.centre - 25.0 * distance
    edge = np.where(chart.statistic > highest, highest, np.where(chart.statistic < lowest, lowest, np.nan))
    series = [
        *_limits(chart.time_ns, chart.lower_limit, chart.upper_limit),
        Series("centre", chart.time_ns, chart.centre, LIMIT, width=0.6, legend="limits"),
        Series("statistic", chart.time_ns, chart.statistic, RESIDUAL),
    ]
    # Rerun draws lines in the order of their names: points out of limits are drawn last
    out = _select(chart.out == 1.0, chart.statistic)
    if np.isfinite(out).any():
        series.append(Series("statistic out", chart.time_ns, out, ALARM, legend="out of limits"))
    shown = None
    if np.isfinite(edge).any():
        series.append(
            Series("statistic out of the plot", chart.time_ns, edge, ALARM, width=4.0, legend="out of limits")
        )
        within = np.clip(chart.statistic, lowest, highest)
        shown = _with_margin(np.concatenate([within, chart.upper_limit, chart.lower_limit]))
    return TimePlot(f"Chart {name}", "", tuple(series), shown)


def _select(mask: NDArray[np.bool_], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values where `mask` is True, each with the value before it so that lines connect; NaN elsewhere."""
    following = np.append(mask[1:], False)
    return np.where(mask | following, values, np.nan)


def _with_margin(values: NDArray[np.float64]) -> tuple[float, float] | None:
    values = values[np.isfinite(values)]
    margin = 0.08 * float(np.ptp(values)) if values.size else 0.0
    return (float(values.min()) - margin, float(values.max()) + margin) if margin > 0.0 else None


CHARTS = Panel("Residuals and charts", draw_charts, arranged="grid")


_KINDS = {"a": "of the output", "b": "of the input", "c": "offset"}
_NAME = re.compile(r"(\D+)\d*(?:_(\d+))?")
"""Letter, lag and, of several inputs, number of the input in the name of a parameter."""
_FIXED = {REFERENCE: "reference model", FROZEN: "model frozen since the training"}
"""Labels of models that do not adapt."""


def draw_models(run: RunColumns) -> tuple[TimePlot, ...]:
    """Plots for each signal of each kind of parameter, of the excitation and of the noise levels."""
    identified = {name: items for name, items in run.models.items() if name[1] != EQUATIONS}
    signals = sorted({signal for signal, _ in identified})
    names = sorted({parameter.name for items in identified.values() for item in items for parameter in item.parameters})
    kinds = sorted(set(map(_kind, names)))
    plots = [_parameters(run, signal, kind, names) for kind in kinds for signal in signals]
    by_equations = sorted(signal for signal, purpose in run.models if purpose == EQUATIONS)
    return (
        *plots,
        *(_excitation(run, signal) for signal in signals),
        *(_noise(run, signal) for signal in by_equations),
    )


def _kind(name: str) -> tuple[str, int]:
    """Letter of a parameter and the number of its signal, from 1; 0: there is only one."""
    match = _NAME.fullmatch(name)
    return (match[1], int(match[2] or 0)) if match is not None else (name, 0)


def _parameters(run: RunColumns, signal: str, kind: tuple[str, int], names: list[str]) -> TimePlot:
    series: list[Series] = []
    letter, number = kind
    for index, name in enumerate(name for name in names if _kind(name) == kind):
        colour = SEVERAL[index % len(SEVERAL)]
        for purpose in (REFERENCE, FROZEN, ADAPTIVE):
            series += _parameter(name, run.models.get((signal, purpose), ()), colour, purpose)
    meaning = f": {_KINDS[letter]}" if letter in _KINDS else ""
    inputs = () if run.process is None else run.process.inputs
    if number:
        meaning += f" {inputs[number - 1] if number <= len(inputs) else number}"
    return TimePlot(f"Parameters {letter} of the model of {signal}{meaning}", "", tuple(series))


def _values(name: str, items: Iterable[messages.ModelSnapshot]) -> tuple[Times, Values, Values]:
    """Times, values and standard deviations of a parameter in the snapshots that have it."""
    found = [(item.time_ns, each.value, each.sd) for item in items for each in item.parameters if each.name == name]
    time_ns, value, sd = zip(*found, strict=True) if found else ((), (), ())
    return np.array(time_ns, np.int64), np.array(value, float), np.array(sd, float)


def _parameter(name: str, items: Iterable[messages.ModelSnapshot], colour: Colour, purpose: str) -> Iterator[Series]:
    time_ns, value, sd = _values(name, items)
    if not time_ns.size:
        return
    sd = np.where(np.isfinite(sd), sd, np.nan)  # infinite without information in the data: no interval is drawn
    if purpose in _FIXED:
        label = _FIXED[purpose]
        yield Series(f"{name} {label}", time_ns, value, colour, width=0.8, legend=f"{name}, {label}")
        return
    for sign, side in ((1.96, "upper"), (-1.96, "lower")):
        yield Series(f"{name} {side} end", time_ns, value + sign * sd, LIMIT, width=0.5, legend="95 % interval")
    yield Series(name, time_ns, value, colour, width=2.0)


def _excitation(run: RunColumns, signal: str) -> TimePlot:
    names = ((REFERENCE, _FIXED[REFERENCE], LIMIT), (FROZEN, _FIXED[FROZEN], PREDICTED))
    series = [
        Series(name, times_of(items), np.array([item.excitation for item in items]), colour)
        for purpose, name, colour in (*names, (ADAPTIVE, "adaptive model", MEASURED))
        if (items := run.models.get((signal, purpose), ()))
    ]
    return TimePlot(f"Excitation of the model of {signal}", "", tuple(series))


def _noise(run: RunColumns, signal: str) -> TimePlot:
    """Noise levels: standard deviation of the sensor in its unit, of the states per square root of a minute."""
    items = run.models[signal, EQUATIONS]
    series = []
    for index, name in enumerate(dict.fromkeys(each.name for item in items for each in item.parameters)):
        time_ns, value, _ = _values(name, items)
        series.append(Series(name, time_ns, value, SEVERAL[index % len(SEVERAL)], held=True))
    return TimePlot(f"Noise levels of the equations for {signal}", "", tuple(series))


MODELS = Panel("Model", draw_models, arranged="grid")
