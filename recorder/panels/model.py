"""The models: parameters as they are learned and as rows are judged by, noise levels, and excitation.

Excitation is the smallest over the largest singular value of the scaled regressor: where it is near 0, what is learned
of the parameters is noise.
"""

from collections.abc import Iterator

import numpy as np

from recorder.columns.run import ADAPTS, EQUATIONS, HELD, JUDGES, Run, Snapshot
from recorder.panels.base import LIMIT, MEASURED, PREDICTED, SEVERAL, Colour, Panel, Series, TimePlot

_KINDS = {"a": "of its own past", "b": "of the input", "c": "offset"}
_HELD = {JUDGES: "judged by", HELD: "held since the training"}
"""Names of the lines of models that do not adapt."""


def draw(run: Run) -> tuple[TimePlot, ...]:
    """Of each kind of parameter, of the noise levels and of the excitation, a plot for each signal."""
    identified = {name: items for name, items in run.models.items() if name[1] != EQUATIONS}
    signals = sorted({signal for signal, _ in identified})
    names = sorted({name for items in identified.values() for item in items for name in item.parameters})
    kinds = sorted({name.rstrip("0123456789") for name in names})
    plots = [_parameters(run, signal, kind, names) for kind in kinds for signal in signals]
    judged = sorted(signal for signal, use in run.models if use == EQUATIONS)
    return (*plots, *(_excitation(run, signal) for signal in signals), *(_noise(run, signal) for signal in judged))


def _parameters(run: Run, signal: str, kind: str, names: list[str]) -> TimePlot:
    series: list[Series] = []
    for number, name in enumerate(name for name in names if name.rstrip("0123456789") == kind):
        colour = SEVERAL[number % len(SEVERAL)]
        for use in (JUDGES, HELD, ADAPTS):
            items = [item for item in run.models.get((signal, use), ()) if name in item.parameters]
            if items:
                series += _parameter(name, items, colour, use)
    meaning = f" {_KINDS[kind]}" if kind in _KINDS else ""
    return TimePlot(f"Parameters {kind} of the model of {signal}:{meaning}", "", tuple(series))


def _parameter(name: str, items: list[Snapshot], colour: Colour, use: str) -> Iterator[Series]:
    time_ns = np.array([item.time_ns for item in items], np.int64)
    value, sd = np.array([item.parameters[name] for item in items]).T
    sd = np.where(np.isfinite(sd), sd, np.nan)  # infinite where the data tell nothing: there is no interval to draw
    if use in _HELD:
        yield Series(f"{name} {_HELD[use]}", time_ns, value, colour, width=0.8, legend=f"{name}, {_HELD[use]}")
        return
    for sign, side in ((1.96, "upper"), (-1.96, "lower")):
        yield Series(f"{name} {side} end", time_ns, value + sign * sd, LIMIT, width=0.5, legend="95 % interval")
    yield Series(name, time_ns, value, colour, width=2.0)


def _excitation(run: Run, signal: str) -> TimePlot:
    series = []
    for use, name, colour in (
        (JUDGES, "of the model judged by", LIMIT),
        (HELD, "of the model held since the training", PREDICTED),
        (ADAPTS, "of the model that adapts", MEASURED),
    ):
        items = run.models.get((signal, use), ())
        if items:
            time_ns = np.array([item.time_ns for item in items], np.int64)
            series.append(Series(name, time_ns, np.array([item.excitation for item in items]), colour))
    return TimePlot(f"Excitation that the model of {signal} learned from", "", tuple(series))


def _noise(run: Run, signal: str) -> TimePlot:
    """Standard deviations: of the sensor in its unit, of the states in theirs per square root of a minute."""
    items = run.models[signal, EQUATIONS]
    names = dict.fromkeys(name for item in items for name in item.parameters)
    series = []
    for number, name in enumerate(names):
        known = [item for item in items if name in item.parameters]
        time_ns = np.array([item.time_ns for item in known], np.int64)
        value = np.array([item.parameters[name][0] for item in known])
        series.append(Series(name, time_ns, value, SEVERAL[number % len(SEVERAL)], held=True))
    return TimePlot(f"Noise levels by which the equations judge {signal}", "", tuple(series))


PANEL = Panel("Model", draw, arranged="grid")
