"""Models: parameters of the adaptive, frozen and reference model, noise levels, and excitation.

Excitation is the ratio of the smallest to the largest singular value of the scaled regressor. Where it is near 0, the
estimated parameters are noise.
"""

import re
from collections.abc import Iterator

import numpy as np

from recorder.columns.run import ADAPTIVE, EQUATIONS, FROZEN, REFERENCE, RunColumns, Snapshot
from recorder.panels.base import LIMIT, MEASURED, PREDICTED, SEVERAL, Colour, Panel, Series, TimePlot

_KINDS = {"a": "of the output", "b": "of the input", "c": "offset"}
_NAME = re.compile(r"(\D+)\d*(?:_(\d+))?")
"""Letter, lag and, of several inputs, number of the input in the name of a parameter."""
_FIXED = {REFERENCE: "reference model", FROZEN: "model frozen since the training"}
"""Labels of models that do not adapt."""


def draw(run: RunColumns) -> tuple[TimePlot, ...]:
    """Plots for each signal of each kind of parameter, of the excitation and of the noise levels."""
    identified = {name: items for name, items in run.models.items() if name[1] != EQUATIONS}
    signals = sorted({signal for signal, _ in identified})
    names = sorted({name for items in identified.values() for item in items for name in item.parameters})
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
            items = [item for item in run.models.get((signal, purpose), ()) if name in item.parameters]
            if items:
                series += _parameter(name, items, colour, purpose)
    meaning = f": {_KINDS[letter]}" if letter in _KINDS else ""
    inputs = () if run.process is None else run.process.inputs
    if number:
        meaning += f" {inputs[number - 1] if number <= len(inputs) else number}"
    return TimePlot(f"Parameters {letter} of the model of {signal}{meaning}", "", tuple(series))


def _parameter(name: str, items: list[Snapshot], colour: Colour, purpose: str) -> Iterator[Series]:
    time_ns = np.array([item.time_ns for item in items], np.int64)
    value, sd = np.array([item.parameters[name] for item in items]).T
    sd = np.where(np.isfinite(sd), sd, np.nan)  # infinite without information in the data: no interval is drawn
    if purpose in _FIXED:
        label = _FIXED[purpose]
        yield Series(f"{name} {label}", time_ns, value, colour, width=0.8, legend=f"{name}, {label}")
        return
    for sign, side in ((1.96, "upper"), (-1.96, "lower")):
        yield Series(f"{name} {side} end", time_ns, value + sign * sd, LIMIT, width=0.5, legend="95 % interval")
    yield Series(name, time_ns, value, colour, width=2.0)


def _excitation(run: RunColumns, signal: str) -> TimePlot:
    series = []
    for purpose, name, colour in (
        (REFERENCE, _FIXED[REFERENCE], LIMIT),
        (FROZEN, _FIXED[FROZEN], PREDICTED),
        (ADAPTIVE, "adaptive model", MEASURED),
    ):
        items = run.models.get((signal, purpose), ())
        if items:
            time_ns = np.array([item.time_ns for item in items], np.int64)
            series.append(Series(name, time_ns, np.array([item.excitation for item in items]), colour))
    return TimePlot(f"Excitation of the model of {signal}", "", tuple(series))


def _noise(run: RunColumns, signal: str) -> TimePlot:
    """Noise levels: standard deviation of the sensor in its unit, of the states per square root of a minute."""
    items = run.models[signal, EQUATIONS]
    names = dict.fromkeys(name for item in items for name in item.parameters)
    series = []
    for index, name in enumerate(names):
        given = [item for item in items if name in item.parameters]
        time_ns = np.array([item.time_ns for item in given], np.int64)
        value = np.array([item.parameters[name][0] for item in given])
        series.append(Series(name, time_ns, value, SEVERAL[index % len(SEVERAL)], held=True))
    return TimePlot(f"Noise levels of the equations for {signal}", "", tuple(series))


PANEL = Panel("Model", draw, arranged="grid")
