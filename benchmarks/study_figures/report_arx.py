"""Figures 5 and 6: the report's ARX(3,3) model, its estimation and its simulation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.study_figures.canvas import BLACK, BLUE, ORANGE, VERMILION, label, legend_below, panels
from benchmarks.study_figures.figure import Finding, Verdict, verdict
from benchmarks.study_figures.report_scheme import EVERY, ORDER, SKIP
from benchmarks.study_figures.study import NAMES, OUTPUTS, Study, holdout_half
from reactorwatch.identification.least_squares import SINGULAR_CONDITION
from reactorwatch.identification.linear_model import LinearModel, fit_percent
from reactorwatch.identification.structure import Structure

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

_SHOWN_MIN = 30.0


def estimate(study: Study, drawing: Drawing) -> Finding:
    """Figure 5: parameters of the report's scheme beside those of all rows."""
    axes = panels(drawing, 1, 2)
    names = Structure.of_order(ORDER).parameter_names()[:-1]
    rows, singular = [], False
    for one, output in zip(axes, OUTPUTS, strict=True):
        reported, fitted_to_all = study.report_fit("arx", ORDER, output), study.fit("arx", ORDER, output)
        assert isinstance(fitted_to_all, LinearModel)
        scale = np.repeat([1.0, study.spread(output) / study.spread("qc")], ORDER)
        x = np.arange(len(names))
        one.bar(x - 0.2, reported.parameters[:-1] / scale, 0.36, color=ORANGE, label="report's scheme")
        one.bar(x + 0.2, fitted_to_all.parameters[:-1] / scale, 0.36, color=BLUE, label="all rows")
        one.set_xticks(x, names)
        label(one, "parameter", "of scaled signals", f"ARX({ORDER},{ORDER}) of {output}")
        singular |= reported.condition > SINGULAR_CONDITION
        for name, model in (("report's scheme", reported), ("all rows", fitted_to_all)):
            condition = f"{model.condition:.3g}" if model.condition <= SINGULAR_CONDITION else "singular"
            values = " | ".join(f"{value:.4g}" for value in model.parameters[:-1])
            rows.append(f"| {output} | {name} | {model.rows} | {condition} | {values} |")
    legend_below(drawing, axes[0], 2)
    text = (
        f"The scheme in full: rows {SKIP + 1}, {SKIP + 1 + EVERY}, ... are fitted, "
        "their lags are the rows just before them, and the pseudo-inverse solves. The report scales its signals "
        "and does not give the factors; here each is centred and divided by its standard deviation, and the "
        f"parameters below are those of the signals' own units. Fitted to the first half of {study.source}.\n\n"
        f"| output | fit | rows | condition number | {' | '.join(names)} |\n|---|---|---|---|{'---|' * len(names)}\n"
        + "\n".join(rows)
    )
    if singular:
        text += (
            "\n\nThe report's rows do not determine six parameters here: the input moves in step with the choice of "
            "rows, two of its lags are equal in all of them, and the pseudo-inverse gives the solution of least norm."
        )
    return Finding(text)


def simulate(study: Study, drawing: Drawing) -> Finding:
    """Figure 6: the model run on its own outputs."""
    axes = panels(drawing, 2, 1, sharex=True)
    fits = {}
    for one, output in zip(axes, OUTPUTS, strict=True):
        u, y, t = (holdout_half(values) for values in study.signals(output))
        run = study.report_fit("arx", ORDER, output).simulate(u, y, t)[:, 0]
        fitted_to_all = study.fit("arx", ORDER, output).simulate(u, y, t)[:, 0]
        fits[output] = (fit_percent(y, run), fit_percent(y, fitted_to_all))
        shown = t <= t[0] + _SHOWN_MIN
        one.plot(t[shown], y[shown], ".", color=BLACK, markersize=3, label="measured")
        one.plot(t[shown], run[shown], color=VERMILION, label="report's scheme, simulated")
        one.plot(t[shown], fitted_to_all[shown], "--", color=BLUE, label="all rows, simulated")
        label(one, "time, min" if one is axes[-1] else "", NAMES[output])
    legend_below(drawing, axes[0], 3)
    lines = "\n".join(f"| {output} | {fit[0]:.1f} % | {fit[1]:.1f} % |" for output, fit in fits.items())
    text = (
        "The models run on their own outputs over the half that they were not fitted to; 100 % is perfect, 0 % is as "
        f"good as the mean:\n\n| output | report's scheme | all rows |\n|---|---|---|\n{lines}"
    )
    followed = [fit[0] > 50.0 for fit in fits.values()]
    return Finding(text, Verdict.IN_PART if any(followed) and not all(followed) else verdict(all(followed)))
