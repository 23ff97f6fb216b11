"""Figures 14 to 16: ARX and output-error models of orders 1 to 3 on rows that they were not fitted to."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.study_figures.canvas import BLACK, BY_ORDER, label, legend_below, panels
from benchmarks.study_figures.figure import Finding, verdict
from benchmarks.study_figures.study import NAMES, ORDERS, OUTPUTS, Study, holdout_half
from reactorwatch.identification.linear_model import fit_percent
from reactorwatch.process.library.cstr.model import cstr

UNITS = cstr().units

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

_SHOWN_MIN = 15.0
_SETTLED_MIN = 5.0
"""Time after which the noise in the initial rows of a simulation has died out."""
_STYLES = {1: ":", 2: "--", 3: "-"}


def arx_one_step(study: Study, drawing: Drawing) -> Finding:
    """Figure 14."""
    return _draw(study, drawing, "arx", free=False)


def arx_free_run(study: Study, drawing: Drawing) -> Finding:
    """Figure 15."""
    return _draw(study, drawing, "arx", free=True)


def oe_free_run(study: Study, drawing: Drawing) -> Finding:
    """Figure 16."""
    return _draw(study, drawing, "oe", free=True)


def _draw(study: Study, drawing: Drawing, family: str, free: bool) -> Finding:
    axes = panels(drawing, 2, 2, sharex=True, gridspec_kw={"height_ratios": (3, 2)})
    fits: dict[tuple[int, str], float] = {}
    settled: dict[tuple[int, str], float] = {}
    for output, over, under in zip(("T", "C"), axes[:2], axes[2:], strict=True):
        u, y, t = (holdout_half(values) for values in study.signals(output))
        shown = t <= t[0] + _SHOWN_MIN
        over.plot(t[shown], y[shown], ".", color=BLACK, markersize=3, label="measured")
        for order in ORDERS:
            model = study.fit(family, order, output)
            predicted = (model.simulate if free else model.predict)(u, y, t)[:, 0]
            fits[order, output] = fit_percent(y, predicted)
            settled[order, output] = fit_percent(y[t > t[0] + _SETTLED_MIN], predicted[t > t[0] + _SETTLED_MIN])
            line: dict[str, Any] = {"linestyle": _STYLES[order], "color": BY_ORDER[order], "linewidth": 1.3}
            over.plot(t[shown], predicted[shown], label=f"order {order}", **line)
            under.plot(t[shown], (y - predicted)[shown], **line)
        label(over, "", NAMES[output])
        label(under, "time, min", f"measured - {'run' if free else 'predicted'}, {UNITS[output]}")
    legend_below(drawing, axes[0], 4)
    best = {output: max(ORDERS, key=lambda order: fits[order, output]) for output in OUTPUTS}
    if free:
        later = f"after the first {_SETTLED_MIN:g} min"
        head = f"| order | C | T | C {later} | T {later} |\n|---|---|---|---|---|"
    else:
        head = "| order | C | T |\n|---|---|---|"
    tables = (fits, settled) if free else (fits,)
    rows = "\n".join(
        f"| {order} | " + " | ".join(f"{table[order, output]:.1f} %" for table in tables for output in OUTPUTS) + " |"
        for order in ORDERS
    )
    text = (
        f"Fitted to the first half, shown and measured on the second: {study.source}. "
        f"{'Simulation' if free else 'One-step-ahead prediction'}, 100 % is perfect, 0 % is as good as the mean:\n\n"
        f"{head}\n{rows}\n\n"
        f"Best for C is order {best['C']}, by {_lead(fits, 'C'):.2f} points; for T order {best['T']}, by "
        f"{_lead(fits, 'T'):.2f}."
    )
    if free:
        text += (
            " A simulation starts from measured rows, whose errors show in its first minutes; without these the "
            f"third order is ahead of the best of the others by {_third_lead(settled, 'C'):+.2f} points for C and "
            f"{_third_lead(settled, 'T'):+.2f} for T."
        )
    return Finding(text, verdict(all(order == max(ORDERS) for order in best.values())))


def _lead(fits: dict[tuple[int, str], float], output: str) -> float:
    """Lead of the best order over the next, in points."""
    ranked = np.sort([fits[order, output] for order in ORDERS])
    return float(ranked[-1] - ranked[-2])


def _third_lead(fits: dict[tuple[int, str], float], output: str) -> float:
    """Lead of the highest order over the best of the others, in points."""
    return fits[max(ORDERS), output] - max(fits[order, output] for order in ORDERS[:-1])
