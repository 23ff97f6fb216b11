"""Figures 11 to 16: ARX and output-error models of orders 1 to 3 on rows that they were not fitted to."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.study_figures.canvas import BLACK, BLUE, ORANGE, label, legend_below, panels
from benchmarks.study_figures.figure import Finding, Verdict
from benchmarks.study_figures.study import NAMES, ORDERS, OUTPUTS, Study, holdout_half
from reactorwatch.identification.linear_model import fit_percent

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

_SHOWN_MIN = 15.0
_TITLES = {"arx": "one-step-ahead prediction", "oe": "simulation"}


def compare(family: str, order: int) -> Callable[[Study, Drawing], Finding]:
    """Function that draws one model, by the report's scheme and by least squares of all rows."""

    def draw(study: Study, drawing: Drawing) -> Finding:
        return _draw(study, drawing, family, order)

    return draw


def _draw(study: Study, drawing: Drawing, family: str, order: int) -> Finding:
    axes = panels(drawing, 2, 2, sharex=True, gridspec_kw={"height_ratios": (3, 2)})
    for output, over, under in zip(OUTPUTS, axes[:2], axes[2:], strict=True):
        u, y, t = (holdout_half(values) for values in study.signals(output))
        shown = t <= t[0] + _SHOWN_MIN
        over.plot(t[shown], y[shown], ".", color=BLACK, markersize=3, label="measured")
        for name, model, colour, style in (
            ("report's scheme", study.report_fit(family, order, output), ORANGE, "-"),
            ("all rows, least squares of that error", study.fit(family, order, output), BLUE, "--"),
        ):
            predicted = (model.predict if family == "arx" else model.simulate)(u, y, t)[:, 0]
            over.plot(t[shown], predicted[shown], style, color=colour, linewidth=1.3, label=name)
            under.plot(t[shown], (y - predicted)[shown], style, color=colour, linewidth=1.0)
        label(over, "", NAMES[output])
        label(under, "time, min", "measured - model")
    legend_below(drawing, axes[0], 3)
    fits = {key: _fits(study, family, key) for key in ORDERS}
    best = {output: max(ORDERS, key=lambda key: fits[key][output][0]) for output in OUTPUTS}
    table = "\n".join(
        f"| {key} | " + " | ".join(f"{fits[key][output][i]:.1f} %" for i in (0, 1) for output in OUTPUTS) + " |"
        for key in ORDERS
    )
    text = (
        f"Fitted to the first half, shown and measured on the second: {study.source}. {_TITLES[family].capitalize()}; "
        "100 % is perfect, 0 % is as good as the mean:\n\n"
        "| order | C, report's scheme | T, report's scheme | C, all rows | T, all rows |\n|---|---|---|---|---|\n"
        f"{table}"
    )
    if family == "oe":
        text += (
            "\n\nThe report's output-error iteration regresses the model's output on itself, and an output satisfies "
            f"the model that made it: the parameters moved by at most {_largest_change(study, order):.1e} of their "
            "size. "
            "The report's OE model is its ARX model, simulated; the other column is fitted by the error of the "
            "simulation."
        )
    if order != max(ORDERS):
        return Finding(text)
    text += f"\n\nWith the report's scheme, order {best['C']} is best for C and order {best['T']} for T."
    if family == "arx":
        gains = {
            key: [float(np.linalg.norm(study.report_fit("arx", key, o).parameters[:key])) for o in OUTPUTS]
            for key in ORDERS
        }
        told = ", ".join(f"{gains[key][0]:.2f} and {gains[key][1]:.2f} at order {key}" for key in ORDERS)
        above = [key for key in ORDERS[:-1] if all(gains[max(ORDERS)][i] > gains[key][i] for i in (0, 1))]
        judged = (
            "is so"
            if len(above) == len(ORDERS) - 1
            else "is so against the first order alone"
            if above
            else "is not so"
        )
        text += (
            f" That a model of the third order takes more noise in, as three past measurements enter it, {judged}: in "
            f"a prediction the noise of C and T is {told} times that of the sensor."
        )
    right = [best[output] == max(ORDERS) for output in OUTPUTS]
    return Finding(text, Verdict.AGREES if all(right) else Verdict.IN_PART if any(right) else Verdict.DISAGREES)


def _fits(study: Study, family: str, order: int) -> dict[str, tuple[float, float]]:
    """Fits on the held-out half by the report's scheme and by all rows, for each output."""
    found = {}
    for output in OUTPUTS:
        u, y, t = (holdout_half(values) for values in study.signals(output))
        models = (study.report_fit(family, order, output), study.fit(family, order, output))
        one, two = (
            fit_percent(y, (model.predict if family == "arx" else model.simulate)(u, y, t)[:, 0]) for model in models
        )
        found[output] = (one, two)
    return found


def _largest_change(study: Study, order: int) -> float:
    """Largest change of a parameter by the output-error iteration, as a share of the largest parameter."""
    changes = []
    for output in OUTPUTS:
        arx, oe = (study.report_fit(family, order, output).parameters[:-1] for family in ("arx", "oe"))
        changes.append(float(np.abs(oe - arx).max() / np.abs(arx).max()))
    return max(changes)
