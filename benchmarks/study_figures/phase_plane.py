"""Section 3.2: where the reactor goes from many starts at one coolant flow."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.study_figures.canvas import BLACK, BLUE, GREEN, ORANGE, label, legend_below, panels
from benchmarks.study_figures.figure import Finding, verdict
from benchmarks.study_figures.study import NAMES, Study, row_times
from reactorwatch.process.library.cstr import OPERATING_COOLANT_FLOW

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

_STARTS = [(C, T) for C in (0.02, 0.2, 0.4, 0.6, 0.8, 0.98) for T in (345.0, 375.0, 405.0, 435.0, 465.0)]
_SPAN_MIN, _PERIOD_MIN = 20.0, 0.02
_ARRIVED = np.array([0.005, 0.5])  # mol/l and K


def draw(study: Study, drawing: Drawing) -> Finding:
    """Trajectories, coloured by where they end."""
    (axes,) = panels(drawing, 1, 1)
    extinguished, saddle, operating = (point.state for point in study.points(OPERATING_COOLANT_FLOW))
    time_min = row_times(round(_SPAN_MIN / _PERIOD_MIN) + 1, _PERIOD_MIN)
    inputs = np.full(time_min.size, OPERATING_COOLANT_FLOW)
    counts = {"operating": 0, "extinguished": 0, "neither": 0}
    hottest = 0.0
    for start in _STARTS:
        states = study.simulator.run(time_min, inputs, np.array(start)).states
        hottest = max(hottest, float(states[:, 1].max()))
        ends = {"operating": operating, "extinguished": extinguished}
        end = next((name for name, x in ends.items() if np.all(np.abs(states[-1] - x) < _ARRIVED)), "neither")
        counts[end] += 1
        colour = {"operating": BLUE, "extinguished": GREEN, "neither": BLACK}[end]
        name = f"ends {end}" if counts[end] == 1 else "_"
        axes.plot(states[:, 0], states[:, 1], color=colour, linewidth=1, alpha=0.8, label=name)
        axes.plot(*start, ".", color=colour, markersize=5)
    axes.plot(*operating, "o", color=BLUE, markersize=10, markeredgecolor="white", zorder=4, label="operating state")
    axes.plot(*saddle, "X", color=ORANGE, markersize=10, markeredgecolor="white", zorder=4, label="saddle")
    axes.plot(
        *extinguished, "s", color=GREEN, markersize=9, markeredgecolor="white", zorder=4, label="extinguished state"
    )
    label(axes, NAMES["C"], NAMES["T"], f"qc = {OPERATING_COOLANT_FLOW} l/min, {_SPAN_MIN:g} min from each start")
    legend_below(drawing, axes, 5)
    text = (
        f"At {OPERATING_COOLANT_FLOW} l/min, of {len(_STARTS)} starts {counts['operating']} end in the operating "
        f"state (C = {operating[0]:.4f} mol/l, T = {operating[1]:.2f} K), {counts['extinguished']} in the "
        f"extinguished one ({extinguished[0]:.4f}, {extinguished[1]:.2f}), {counts['neither']} elsewhere; none stays "
        f"at the saddle ({saddle[0]:.4f}, {saddle[1]:.2f}). Igniting overshoots: the hottest that any of them gets is "
        f"{hottest:.0f} K."
    )
    return Finding(text, verdict(counts["operating"] > 0 and counts["extinguished"] > 0))
