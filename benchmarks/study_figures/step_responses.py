"""Figure 3: the plant's responses at coolant flows from 85 to 110 l/min."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.study_figures.canvas import BLACK, BLUE, GREEN, ORANGE, PURPLE, VERMILION, label, legend_below, panels
from benchmarks.study_figures.figure import Finding, Verdict
from benchmarks.study_figures.study import NAMES, Study, edge, row_times

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

_FLOWS = {85.0: BLUE, 90.0: GREEN, 95.0: PURPLE, 100.0: ORANGE, 105.0: VERMILION, 110.0: BLACK}
_STEP = 1.0  # l/min
_SPAN_MIN, _BEFORE_MIN, _PERIOD_MIN = 20.0, 0.5, 0.005
_SHOWN_MIN = 8.0
_VISIBLE = 0.5  # % of the change: a smaller overshoot cannot be seen in a plot


def draw(study: Study, drawing: Drawing) -> Finding:
    """C and T after a step that ends at each flow."""
    axes_of = dict(zip("CT", panels(drawing, 2, 1, sharex=True), strict=True))
    time_min = row_times(round((_SPAN_MIN + _BEFORE_MIN) / _PERIOD_MIN) + 1, _PERIOD_MIN) - _BEFORE_MIN
    shown = time_min <= _SHOWN_MIN
    overshoots, rows = {}, []
    for flow, colour in _FLOWS.items():
        start, end = study.operating(flow - _STEP), study.operating(flow)
        inputs = flow - _STEP + np.where(time_min >= -1e-9, _STEP, 0.0)
        share = (study.simulator.run(time_min, inputs, start.state).states - start.state) / (end.state - start.state)
        overshoots[flow] = 100 * np.maximum(share.max(axis=0) - 1, 0.0)
        for index, name in enumerate("CT"):
            axes_of[name].plot(time_min[shown], 100 * share[shown, index], color=colour, label=f"to {flow:g} l/min")
        poles = end.eigenvalues
        named = (
            ", ".join(f"{pole.real:.2f}" for pole in np.sort_complex(poles))
            if np.all(poles.imag == 0)
            else f"{poles[0].real:.2f} +- {abs(poles[0].imag):.2f}i"
        )
        rows.append(f"| {flow:g} | {named} | {overshoots[flow][0]:.1f} % | {overshoots[flow][1]:.1f} % |")
    for name, axes in axes_of.items():
        label(
            axes,
            "minutes after the step" if name == "T" else "",
            f"change of {NAMES[name].split(',')[0]}, % of its end",
        )
    legend_below(drawing, axes_of["C"], 6)
    turn = edge(lambda flow: bool(np.all(study.operating(flow).eigenvalues.imag == 0)), 80.0, 100.0)
    smooth = [flow for flow in _FLOWS if overshoots[flow][0] < _VISIBLE]
    swinging = [flow for flow in _FLOWS if flow not in smooth]
    text = (
        f"Steps of {_STEP:+g} l/min that end at each flow:\n\n"
        "| flow, l/min | poles there, 1/min | overshoot of C | overshoot of T |\n|---|---|---|---|\n"
        + "\n".join(rows)
        + f"\n\nC shows no overshoot at {' and '.join(f'{flow:g}' for flow in smooth)} l/min, and at "
        f"{', '.join(f'{flow:g}' for flow in swinging)} l/min it does. But no response is of first order: the plant "
        f"has two states, and two real poles up to {turn:.1f} l/min; beyond, the poles are a complex pair. The "
        "oscillation "
        "that the report sees from 100 l/min on begins earlier and grows steadily; at 95 l/min it is too small to be "
        "seen at a plot's scale."
    )
    right = {85.0, 90.0} <= set(smooth) and {100.0, 105.0, 110.0} <= set(swinging)
    return Finding(text, Verdict.IN_PART if right else Verdict.DISAGREES)
