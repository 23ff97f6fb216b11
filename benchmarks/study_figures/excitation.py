"""Section 3.5: which inputs excite a model enough to be learned."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.study_figures.canvas import BLUE, GREEN, VERMILION, label, panels
from benchmarks.study_figures.figure import Finding, verdict
from benchmarks.study_figures.study import ORDERS, Study, levels, row_times
from plant_node.scenario import RandomSteps, Scenario, Sines, Square
from reactorwatch.identification.checks import persistence

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

_INPUTS: tuple[tuple[str, Scenario], ...] = (
    ("single sinusoid", Sines(100.0, (6.0,), (5.0,))),
    ("sum of three sinusoids", Sines(100.0, (4.0, 3.0, 2.0), (3.1, 7.3, 19.7))),
    ("square wave", Square(95.0, 105.0, 20.0)),
    ("random steps", RandomSteps(90.0, 111.0, 1.0)),
)
_ROWS, _PERIOD_MIN, _SHOWN_MIN = 4000, 0.1, 40.0


def draw(study: Study, drawing: Drawing) -> Finding:
    """Each input, its spectrum, and what the check says of it."""
    time_min = row_times(_ROWS, _PERIOD_MIN)
    frequency = np.fft.rfftfreq(_ROWS, _PERIOD_MIN)
    needed = 2 * max(ORDERS)
    axes = panels(drawing, len(_INPUTS), 2, sharex="col", gridspec_kw={"width_ratios": (1.0, 1.0)})
    rows, accepted = [], {}
    for (name, scenario), over_time, over_frequency in zip(_INPUTS, axes[::2], axes[1::2], strict=True):
        u = levels(scenario, time_min, study.seed)
        checks = {order: persistence(u, 2 * order) for order in ORDERS}
        accepted[name] = checks[max(ORDERS)].passed
        colour = GREEN if accepted[name] else VERMILION
        shown = time_min <= _SHOWN_MIN
        over_time.step(time_min[shown], u[shown], where="post", color=BLUE, linewidth=1.2)
        spectrum = 2 * np.abs(np.fft.rfft(u - u.mean())) / _ROWS
        over_frequency.semilogy(frequency[1:], np.maximum(spectrum[1:], 1e-4), color=colour, linewidth=1)
        over_frequency.set_ylim(1e-4, 20)
        over_frequency.set_xlim(0, 1.0)
        said = "accepted" if accepted[name] else "refused"
        label(over_time, "", "l/min", name)
        label(over_frequency, "", "l/min", f"excites order {checks[max(ORDERS)].value:.0f} of {needed}: {said}")
        verdicts = " | ".join("accepted" if checks[order].passed else "refused" for order in ORDERS)
        rows.append(f"| {name} | {verdicts} |")
    axes[-2].set_xlabel("time, min")
    axes[-1].set_xlabel("frequency, 1/min (amplitude spectrum)")
    reason = persistence(levels(_INPUTS[0][1], time_min, study.seed), needed).result
    text = (
        "An ARX or OE model of order n has 2 n parameters on past outputs and inputs, and needs an input that excites "
        "as many.\n\n| input | order 1 | order 2 | order 3 |\n|---|---|---|---|\n" + "\n".join(rows) + "\n\n"
        f'What the software says of the single sinusoid for a third-order model: "{reason}".'
    )
    as_reported = not accepted["single sinusoid"] and accepted["sum of three sinusoids"] and accepted["square wave"]
    return Finding(text, verdict(as_reported))
