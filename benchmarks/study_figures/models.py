"""Figures 5, 6 and 11 to 16, and chapter 4: linear models on rows that they were not fitted to, and the best model."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Drawing

from benchmarks.study_figures.neural import Neural
from benchmarks.study_figures.report_scheme import EVERY, ORDER, SKIP
from benchmarks.study_figures.study import (
    BLACK,
    BLUE,
    NAMES,
    ORANGE,
    ORDERS,
    OUTPUTS,
    PURPLE,
    VERMILION,
    Finding,
    Study,
    Verdict,
    holdout_half,
    label,
    legend_below,
    panels,
    verdict,
)
from reactorwatch.identification.least_squares import SINGULAR_CONDITION
from reactorwatch.identification.linear_model import LinearModel, fit_percent
from reactorwatch.identification.selection import EQUAL_PERCENT, LINEAR_FITS, Candidate, Fit, Selection, select
from reactorwatch.identification.structure import Structure
from reactorwatch.records.record import Record

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


_SHORT_MIN = 15.0
_MODES = {"arx": "one-step-ahead prediction", "oe": "simulation"}


def compare_orders(study: Study, drawing: Drawing, family: str, order: int) -> Finding:
    """One model by the report's scheme and by least squares of all rows, on rows that it was not fitted to."""
    axes = panels(drawing, 2, 2, sharex=True, gridspec_kw={"height_ratios": (3, 2)})
    for output, over, under in zip(OUTPUTS, axes[:2], axes[2:], strict=True):
        u, y, t = (holdout_half(values) for values in study.signals(output))
        shown = t <= t[0] + _SHORT_MIN
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
        f"Fitted to the first half, shown and measured on the second: {study.source}. {_MODES[family].capitalize()}; "
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


_TITLES = {"arx": "ARX", "oe": "OE", "neural": "neural NARX"}
_COLOURS = {"arx": BLUE, "oe": ORANGE, "neural": PURPLE}
_THIRD = 3


def best_model(study: Study, drawing: Drawing) -> Finding:
    """Free-run and one-step fits of every family and order."""
    records: dict[str, tuple[Record, Mapping[str, Fit]]] = {
        study.source: (study.identification, {**LINEAR_FITS, "neural": Neural().fit}),
        "the same run without noise": (study.noise_free, LINEAR_FITS),
        "steps within 0.1 l/min of 100 l/min, without noise, where the plant is nearly linear": (
            study.small_steps,
            LINEAR_FITS,
        ),
    }
    selections = {
        (name, output): select(record.columns["qc"], record.columns[output], record.time_min, of_it, ORDERS)
        for name, (record, of_it) in records.items()
        for output in OUTPUTS
    }
    axes = panels(drawing, 1, 2, sharey=True)
    for one, output in zip(axes, OUTPUTS, strict=True):
        _bars(one, selections[study.source, output], f"{output}, on the held-out half")
    handles, _ = axes[0].get_legend_handles_labels()
    drawing.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    third = ThirdOrder(list(selections.values()))
    parts = []
    for name in records:
        parts += [f"From {name} (bold: the choice):", _table([selections[name, output] for output in OUTPUTS])]
    reasons = " ".join(f"For {output}: {selections[study.source, output].reason}" for output in OUTPUTS)
    parts += [f"The choice, from the first of these records. {reasons}", third.text]
    parts.append(_why(*(_gains(selections, name) for name in records)))
    return Finding("\n\n".join(parts), third.verdict)


class ThirdOrder:
    """Counts of the third order being best, over records, outputs and the linear families."""

    def __init__(self, selections: list[Selection]) -> None:
        groups = [
            [candidate for candidate in selection.candidates if candidate.family == family]
            for selection in selections
            for family in LINEAR_FITS
        ]
        self.of = len(groups)
        self.one_step = sum(_ahead(group, "one_step_percent") >= 0 for group in groups)
        self.bic = sum(min(group, key=lambda candidate: candidate.bic).order == _THIRD for group in groups)
        leads = [_ahead(group, "free_run_percent") for group in groups]
        self.best_run = sum(lead >= 0 for lead in leads)
        self.clearly = sum(lead > EQUAL_PERCENT for lead in leads)
        self.worse = sum(lead < -EQUAL_PERCENT for lead in leads)

    @property
    def text(self) -> str:
        """The count in words."""
        return (
            f"**Is the third order best?** Of {self.of} comparisons of the orders (record, output, ARX or OE) it has "
            f"the best one-step fit in {self.one_step}, the lowest BIC in {self.bic}, the best simulation in "
            f"{self.best_run}; its simulation is better than the next by more than {EQUAL_PERCENT} points in "
            f"{self.clearly}, worse than the best by as much in {self.worse}."
        )

    @property
    def verdict(self) -> Verdict:
        """Verdict on the claim that it is best, by simulation."""
        if self.clearly == self.of:
            return Verdict.AGREES
        return Verdict.IN_PART if self.clearly else Verdict.DISAGREES


def _ahead(group: list[Candidate], fit: str) -> float:
    """Lead of the third order's fit over the best of the others, in points."""
    others = max(getattr(candidate, fit) for candidate in group if candidate.order != _THIRD)
    (own,) = (getattr(candidate, fit) for candidate in group if candidate.order == _THIRD)
    return float(own - others)


def _gains(selections: dict[tuple[str, str], Selection], name: str) -> dict[tuple[str, str], float]:
    """Gain of the third order over the second in simulation fit, in points, by family and output."""
    runs = {
        (candidate.family, candidate.order, output): candidate.free_run_percent
        for output in OUTPUTS
        for candidate in selections[name, output].candidates
    }
    return {
        (family, output): runs[family, _THIRD, output] - runs[family, _THIRD - 1, output]
        for family in LINEAR_FITS
        for output in OUTPUTS
    }


def _why(
    with_noise: dict[tuple[str, str], float],
    without: dict[tuple[str, str], float],
    nearly_linear: dict[tuple[str, str], float],
) -> str:
    """Text on the use of the third lag, from its gains."""

    def gains_text(gains: dict[tuple[str, str], float], family: str) -> str:
        return " and ".join(f"{gains[family, output]:+.2f} in {output}" for output in OUTPUTS)

    text = (
        f"What the third order adds to the second's simulation fit, in points: ARX with noise "
        f"{gains_text(with_noise, 'arx')}, without noise {gains_text(without, 'arx')}; OE with noise "
        f"{gains_text(with_noise, 'oe')}, without {gains_text(without, 'oe')}; where the plant is nearly linear ARX "
        f"{gains_text(nearly_linear, 'arx')}, OE {gains_text(nearly_linear, 'oe')}."
    )
    helps_arx = all(with_noise["arx", output] > EQUAL_PERCENT for output in OUTPUTS)
    helps_else = any(gains["oe", output] > EQUAL_PERCENT for gains in (with_noise, without) for output in OUTPUTS)
    helps_quiet = any(without["arx", output] > EQUAL_PERCENT for output in OUTPUTS)
    if helps_arx and not helps_else and not helps_quiet:
        text += " In these records, then, it helps ARX alone, and that only with noise. The plant has two states."
    return text


def _bars(axes: Axes, selection: Selection, title: str) -> None:
    families = list(dict.fromkeys(candidate.family for candidate in selection.candidates))
    width = 0.8 / len(families)
    for number, family in enumerate(families):
        of_family = [candidate for candidate in selection.candidates if candidate.family == family]
        x = np.array([candidate.order for candidate in of_family]) + (number - (len(families) - 1) / 2) * width
        runs = np.array([candidate.free_run_percent for candidate in of_family])
        steps = [candidate.one_step_percent for candidate in of_family]
        bars = axes.bar(
            x, np.maximum(np.nan_to_num(runs, neginf=0.0), 0.0), 0.92 * width, color=_COLOURS[family],
            label=f"{_TITLES[family]}, simulation",
        )  # fmt: skip
        said = [f"{run:.0f}" if np.isfinite(run) else "away" for run in runs]
        axes.bar_label(bars, said, fontsize=8.5, label_type="center", color="white" if family == "arx" else "black")
        axes.plot(
            x, steps, "_", color="black", markersize=12, markeredgewidth=1.6,
            label="one step" if number == len(families) - 1 else "_",
        )  # fmt: skip
    axes.set_xticks(ORDERS)
    axes.set_ylim(0, 104)
    axes.grid(visible=False, axis="x")
    label(axes, "order", "fit, %", title)


def _table(selections: list[Selection]) -> str:
    lines = [
        "| model | order | C one step, % | C simulation, % | C BIC | T one step, % | T simulation, % | T BIC |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for pair in zip(*(selection.candidates for selection in selections), strict=True):
        cells = []
        for candidate, selection in zip(pair, selections, strict=True):
            mark = "**" if candidate is selection.chosen else ""
            cells.append(
                f"{candidate.one_step_percent:.2f} | {mark}{candidate.free_run_percent:.2f}{mark} | {candidate.bic:.0f}"
                if not candidate.refusal
                else f"{candidate.refusal} | | "
            )
        lines.append(f"| {_TITLES[pair[0].family]} | {pair[0].order} | {' | '.join(cells)} |")
    return "\n".join(lines)
