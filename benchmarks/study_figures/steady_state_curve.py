"""Figure 4: all steady states over the coolant flow, the report's operating point, and the linear model there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq

from benchmarks.study_figures.canvas import BLACK, BLUE, GREEN, ORANGE, SKY, VERMILION, label, legend_below, panels
from benchmarks.study_figures.figure import Finding, Verdict
from benchmarks.study_figures.study import NAMES, Study, edge

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

REPORTED_FLOW, REPORTED_T, REPORTED_C = 100.0, 438.54, 0.103
"""l/min, K and mol/l: the operating point that the report gives."""

_FLOWS = np.arange(60.0, 126.0)
_ZOOM = (96.0, 108.0)
_BRANCHES = (
    ("operating, stable", BLUE, "-"),
    ("operating, unstable", SKY, "--"),
    ("middle: saddle", ORANGE, "--"),
    ("extinguished, stable", GREEN, "-"),
)


def draw(study: Study, drawing: Drawing) -> Finding:
    """Both states of every branch over the flow."""
    for_T, for_C, near_T, near_C = panels(drawing, 2, 2, gridspec_kw={"height_ratios": (5, 3)})
    fold = edge(lambda qc: len(study.points(qc)) == 3, 105.0, 125.0)
    hopf = edge(lambda qc: study.operating(qc).stable, 105.0, fold - 0.01)
    belongs = float(brentq(lambda qc: study.operating(float(qc)).state[1] - REPORTED_T, 90.0, 110.0, xtol=1e-6))
    for_concentration = float(
        brentq(lambda qc: study.operating(float(qc)).state[0] - REPORTED_C, 90.0, 110.0, xtol=1e-6)
    )
    rests, there = study.operating(REPORTED_FLOW).state, study.operating(belongs).state
    flows = np.union1d(_FLOWS, [hopf, fold - 0.01])
    both = flows[flows < fold]
    lines = {
        "operating, stable": [(qc, study.points(qc)[-1]) for qc in both if qc <= hopf],
        "operating, unstable": [(qc, study.points(qc)[-1]) for qc in both if qc >= hopf],
        "middle: saddle": [(qc, study.points(qc)[1]) for qc in both],
        "extinguished, stable": [(qc, study.points(qc)[0]) for qc in flows],
    }
    for axes, index, reported in (
        (for_T, 1, REPORTED_T),
        (for_C, 0, REPORTED_C),
        (near_T, 1, REPORTED_T),
        (near_C, 0, REPORTED_C),
    ):
        zoomed = axes in (near_T, near_C)
        for name, colour, style in _BRANCHES:
            branch = [(qc, point) for qc, point in lines[name] if not zoomed or _ZOOM[0] <= qc <= _ZOOM[1]]
            if zoomed and name != "operating, stable":
                continue
            axes.plot(
                [qc for qc, _ in branch], [point.state[index] for _, point in branch], style, color=colour, label=name
            )
        axes.plot(REPORTED_FLOW, reported, "X", color=VERMILION, markersize=9, zorder=4, label="as the report gives it")
        axes.plot(belongs, there[index], "o", color=BLACK, markersize=6, zorder=4, label="where its T is at rest")
        label(axes, NAMES["qc"] if zoomed else "", NAMES["CT"[index]], "near the operating point" if zoomed else "")
    legend_below(drawing, for_T, 3)
    on_the_curve = bool(abs(rests[1] - REPORTED_T) < 0.01 and abs(rests[0] - REPORTED_C) < 0.0005)
    text = (
        f"Three steady states up to {fold:.2f} l/min, where the operating one and the saddle meet; beyond, only the "
        f"extinguished one is left. The operating one is stable up to {hopf:.2f} l/min (a Hopf point).\n\nThe "
        f"report's point is {'' if on_the_curve else 'not '}on the curve. At {REPORTED_FLOW:g} l/min the reactor "
        f"rests at T = {rests[1]:.2f} K and C = {rests[0]:.4f} mol/l. T = {REPORTED_T:g} K belongs to **{belongs:.2f} "
        f"l/min**, where C = {there[0]:.4f} mol/l; C = {REPORTED_C:g} mol/l belongs to yet another flow, "
        f"{for_concentration:.2f} l/min, where T = {study.operating(for_concentration).state[1]:.2f} K."
    )
    text += (
        "\n\nCaption and text of the report differ here: the text finds the several steady states in this figure, the "
        "caption names the simulation of the linear model. Both are shown: the linear model's response in figures 8 "
        "and 9."
    )
    return Finding(text, Verdict.AGREES if on_the_curve else Verdict.IN_PART)
