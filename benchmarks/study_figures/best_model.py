"""Chapter 4: which model is best, and whether it is the third order's."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.study_figures.canvas import BLUE, ORANGE, PURPLE, label, panels
from benchmarks.study_figures.figure import Finding, Verdict
from benchmarks.study_figures.neural import Neural
from benchmarks.study_figures.study import ORDERS, OUTPUTS, Study
from reactorwatch.identification.selection import EQUAL_PERCENT, LINEAR_FITS, Candidate, Fit, Selection, select
from reactorwatch.records.record import Record

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

_TITLES = {"arx": "ARX", "oe": "OE", "neural": "neural NARX"}
_COLOURS = {"arx": BLUE, "oe": ORANGE, "neural": PURPLE}
_THIRD = 3


def draw(study: Study, drawing: Drawing) -> Finding:
    """Free-run and one-step fits of every family and order."""
    neural = find_spec("sklearn") is not None
    fits = {**LINEAR_FITS, "neural": Neural().fit} if neural else LINEAR_FITS
    records: dict[str, tuple[Record, Mapping[str, Fit]]] = {study.source: (study.identification, fits)}
    if study.measured is None:
        records["the same run without noise"] = (study.noise_free, LINEAR_FITS)
        records["steps within 0.1 l/min of 100 l/min, without noise, where the plant is nearly linear"] = (
            study.small_steps,
            LINEAR_FITS,
        )
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
    if not neural:
        reasons += " (scikit-learn is not installed here, so there is no neural network in the table.)"
    parts += [f"The choice, from the first of these records. {reasons}", third.text]
    if study.measured is None:
        with_noise, without, nearly_linear = (_gains(selections, name) for name in records)
        parts.append(_why(with_noise, without, nearly_linear))
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
