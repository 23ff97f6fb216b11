"""Figure 6: the plant's answers to steps of the coolant flow, nothing controlled."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.study_figures.canvas import BLUE, ORANGE, SKY, VERMILION, label, legend_below, panels
from benchmarks.study_figures.figure import Finding
from benchmarks.study_figures.study import NAMES, Study, row_times
from reactorwatch.process.library.cstr.model import OPERATING_COOLANT_FLOW

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

_STEPS = ((-5.0, BLUE, "-"), (-2.0, SKY, "--"), (2.0, ORANGE, "--"), (5.0, VERMILION, "-"))
_SPAN_MIN, _BEFORE_MIN, _PERIOD_MIN = 8.0, 1.0, 0.02


def draw(study: Study, drawing: Drawing) -> Finding:
    """C and T after steps up and down."""
    axes_of = dict(zip("TC", panels(drawing, 2, 1, sharex=True), strict=True))
    time_min = row_times(round((_SPAN_MIN + _BEFORE_MIN) / _PERIOD_MIN) + 1, _PERIOD_MIN) - _BEFORE_MIN
    start = study.operating().state
    gains, overshoots = {}, {}
    for step, colour, style in _STEPS:
        inputs = OPERATING_COOLANT_FLOW + np.where(time_min >= -1e-9, step, 0.0)
        states = study.simulator.run(time_min, inputs, start).states
        change = study.operating(OPERATING_COOLANT_FLOW + step).state - start
        gains[step] = change / step
        overshoots[step] = 100 * (np.max((states - start) / change, axis=0) - 1)
        for index, name in enumerate("CT"):
            axes_of[name].plot(time_min, states[:, index], style, color=colour, label=f"{step:+g} l/min")
    for name, axes in axes_of.items():
        label(axes, "minutes after the step" if name == "C" else "", NAMES[name])
    legend_below(drawing, axes_of["T"], 4)
    (_, pole) = study.operating().eigenvalues
    rows = "\n".join(
        f"| {step:+g} | {gains[step][0]:.5f} | {gains[step][1]:.3f} | {overshoots[step][0]:.0f} % "
        f"| {overshoots[step][1]:.0f} % |"
        for step, *_ in _STEPS
    )
    ratio = gains[5.0][1] / gains[-5.0][1]
    text = (
        f"From rest at {OPERATING_COOLANT_FLOW} l/min. The linear model there swings with a period of "
        f"{2 * np.pi / abs(pole.imag):.2f} min.\n\n"
        "| step, l/min | gain of C, mol/l per l/min | gain of T, K per l/min | overshoot of C | of T |\n"
        f"|---|---|---|---|---|\n{rows}\n\n"
        f"The plant is not linear: 5 l/min up moves T by {ratio:.2f} times what 5 l/min down does, and swings more."
    )
    return Finding(text)
