"""The identified models: their parameters as they are learned, those that alarms are judged by, and the excitation.

Excitation is the smallest over the largest singular value of the scaled regressor: where it is near 0, what is learned
of the parameters is noise.
"""

from collections.abc import Iterator

import numpy as np

from recorder.panels.base import LIMIT, MEASURED, SEVERAL, Colour, Panel, Series, TimePlot
from recorder.run import Run, Snapshot

_KINDS = {"a": "of its own past", "b": "of the input", "c": "offset"}


def draw(run: Run) -> tuple[TimePlot, ...]:
    """Of each kind of parameter, and of the excitation, a plot for each signal."""
    signals = sorted({signal for signal, _ in run.models})
    names = sorted({name for items in run.models.values() for item in items for name in item.parameters})
    kinds = sorted({name.rstrip("0123456789") for name in names})
    plots = [_parameters(run, signal, kind, names) for kind in kinds for signal in signals]
    return (*plots, *(_excitation(run, signal) for signal in signals))


def _parameters(run: Run, signal: str, kind: str, names: list[str]) -> TimePlot:
    series: list[Series] = []
    for number, name in enumerate(name for name in names if name.rstrip("0123456789") == kind):
        colour = SEVERAL[number % len(SEVERAL)]
        for reference in (True, False):
            items = [item for item in run.models.get((signal, reference), ()) if name in item.parameters]
            if items:
                series += _parameter(name, items, colour, reference=reference)
    meaning = f" {_KINDS[kind]}" if kind in _KINDS else ""
    return TimePlot(f"Parameters {kind} of the model of {signal}:{meaning}", "", tuple(series))


def _parameter(name: str, items: list[Snapshot], colour: Colour, *, reference: bool) -> Iterator[Series]:
    time_ns = np.array([item.time_ns for item in items], np.int64)
    value, sd = np.array([item.parameters[name] for item in items]).T
    sd = np.where(np.isfinite(sd), sd, np.nan)  # infinite where the data tell nothing: there is no interval to draw
    if reference:
        yield Series(f"{name} judged by", time_ns, value, colour, width=0.8, legend=name)
        return
    for sign, side in ((1.96, "upper"), (-1.96, "lower")):
        yield Series(f"{name} {side} end", time_ns, value + sign * sd, LIMIT, width=0.5, legend="95 % interval")
    yield Series(name, time_ns, value, colour, width=2.0)


def _excitation(run: Run, signal: str) -> TimePlot:
    series = []
    for reference, name, colour in (
        (True, "of the model judged by", LIMIT),
        (False, "of the model that adapts", MEASURED),
    ):
        items = run.models.get((signal, reference), ())
        if items:
            time_ns = np.array([item.time_ns for item in items], np.int64)
            series.append(Series(name, time_ns, np.array([item.excitation for item in items]), colour))
    return TimePlot(f"Excitation that the model of {signal} learned from", "", tuple(series))


PANEL = Panel("Model", draw, arranged="grid")
