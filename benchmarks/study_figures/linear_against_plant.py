"""Figures 8 to 10: one linear model, made at 100 l/min, against the plant."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from benchmarks.study_figures.canvas import BLUE, ORANGE, label, legend_below, panels
from benchmarks.study_figures.figure import Finding, Verdict, verdict
from benchmarks.study_figures.steady_state_curve import REPORTED_T
from benchmarks.study_figures.study import NAMES, Study
from reactorwatch.process.library.cstr import OPERATING_COOLANT_FLOW
from reactorwatch.process.linearise import StepComparison, compare_step

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

FLOW = 100.0
"""l/min: flow at which the linear model is made."""
FLOWS = (85.0, 100.0, 110.0)
_UNIT = 1.0  # l/min
_SPAN_MIN, _PERIOD_MIN = 8.0, 0.02
_ACCURATE = 5.0  # % of the change


def step_of_c(study: Study, drawing: Drawing) -> Finding:
    """Figure 8: C after a unit step."""
    return _unit_step(study, drawing, "C")


def step_of_t(study: Study, drawing: Drawing) -> Finding:
    """Figure 9: T after a unit step."""
    return _unit_step(study, drawing, "T")


def compare(study: Study, drawing: Drawing) -> Finding:
    """Figure 10: the linear model after steps to other flows."""
    axes = panels(drawing, 2, 3, sharex=True)
    rows, steady = [], {}
    for column, flow in enumerate(FLOWS):
        # At 100 l/min itself there is nothing to compare at rest, so the unit step stands for it.
        step = flow - FLOW or _UNIT
        compared = _compare(study, step)
        change = study.operating(FLOW + step).outputs - study.operating(FLOW).outputs
        off = 100 * np.abs(compared.linear[-1] - change) / np.abs(change)
        gain = 100 * np.abs(_steady_change(study, step) - change) / np.abs(change)
        steady[flow] = gain
        rows.append(
            f"| {FLOW:g} to {FLOW + step:g} | {gain[0]:.1f} % | {gain[1]:.1f} % | {off[0]:.1f} % | {off[1]:.1f} % | "
            f"{100 * compared.error[0]:.1f} % | {100 * compared.error[1]:.1f} % |"
        )
        for row, index in enumerate((0, 1)):
            one = axes[3 * row + column]
            rest = study.operating(FLOW).outputs[index]
            one.plot(compared.time_min, rest + compared.plant[:, index], color=BLUE, label="plant")
            one.plot(compared.time_min, rest + compared.linear[:, index], "--", color=ORANGE, label="linear model")
            label(
                one,
                "minutes after the step" if row else "",
                NAMES["CT"[index]] if column == 0 else "",
                f"{FLOW:g} to {FLOW + step:g} l/min" if row == 0 else "",
            )
    legend_below(drawing, axes[0], 2)
    worst = {name: max(steady[flow][index] for flow in (85.0, 110.0)) for index, name in enumerate("CT")}
    text = (
        f"One linear model, made at {FLOW:g} l/min, after steps from there. The share of the plant's change by which "
        f"the linear model is wrong at rest, after {_SPAN_MIN:g} min, and (root mean square) over these minutes:\n\n"
        "| step, l/min | at rest: C | at rest: T | at the end: C | at the end: T | overall: C | overall: T |\n"
        "|---|---|---|---|---|---|---|\n" + "\n".join(rows) + "\n\n"
        "That a large step is not followed is right. That the linear model is accurate after a short time is not: its "
        f"error does not fade, for the gain of the plant differs from that at {FLOW:g} l/min. At rest it is up to "
        f"{worst['C']:.0f} % of the change in C and {worst['T']:.0f} % in T. Accurate it is near the flow at which it "
        "was made, as the report concludes."
    )
    return Finding(text, Verdict.IN_PART if worst["C"] > _ACCURATE else Verdict.AGREES)


def _unit_step(study: Study, drawing: Drawing, name: str) -> Finding:
    index = "CT".index(name)
    compared = _compare(study, _UNIT)
    response, difference = panels(drawing, 2, 1, sharex=True, gridspec_kw={"height_ratios": (3, 1)})
    rest = study.operating(FLOW).outputs[index]
    response.plot(compared.time_min, rest + compared.plant[:, index], color=BLUE, label="plant")
    response.plot(compared.time_min, rest + compared.linear[:, index], "--", color=ORANGE, label="linear model")
    difference.plot(compared.time_min, compared.linear[:, index] - compared.plant[:, index], color=ORANGE)
    label(response, "", NAMES[name])
    label(difference, "minutes after the step", "linear - plant")
    legend_below(drawing, response, 2)
    point = study.operating(FLOW)
    largest = 100 * np.abs(compared.linear - compared.plant)[:, index].max() / np.abs(compared.plant[:, index]).max()
    real, imaginary = point.eigenvalues[0].real, abs(point.eigenvalues[0].imag)
    other = study.operating(OPERATING_COOLANT_FLOW)
    text = (
        f"From rest at {FLOW:g} l/min, where C = {point.outputs[0]:.4f} mol/l and T = {point.outputs[1]:.2f} K, a "
        f"step of {_UNIT:+g} l/min. The linear model has the poles {real:.3f} +- {imaginary:.3f}i 1/min. It is at most "
        f"{largest:.1f} % of the plant's largest deviation away from it, and {100 * compared.error[index]:.1f} % (root "
        f"mean square) over {_SPAN_MIN:g} min.\n\nThe report's operating point, {FLOW:g} l/min with {REPORTED_T:g} K, "
        "is no "
        f"steady state of its equations: at {FLOW:g} l/min the reactor rests "
        f"{point.outputs[1] - other.outputs[1]:.2f} K "
        f"higher, and {REPORTED_T:g} K belongs to {OPERATING_COOLANT_FLOW:g} l/min (figure 4)."
    )
    return Finding(text, verdict(bool(largest < _ACCURATE)))


def _compare(study: Study, step: float) -> StepComparison:
    point, flow = study.operating(FLOW).state, np.array([FLOW])
    return compare_step(study.model, point, flow, np.array([step]), _SPAN_MIN, _PERIOD_MIN)


def _steady_change(study: Study, step: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Change of the linear model's outputs at rest after a step, shape (n_y,)."""
    from reactorwatch.process.linearise import linearise

    linear = linearise(study.model, study.operating(FLOW).state, np.array([FLOW]))
    return np.asarray((linear.D - linear.C @ np.linalg.solve(linear.A, linear.B)) @ np.array([step]))
