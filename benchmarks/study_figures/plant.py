"""Figures 3, 4 and 8 to 10, and section 3.2: responses of the plant, its steady states, and the linear model."""

import numpy as np
from matplotlib.figure import Figure as Drawing
from scipy.optimize import brentq

from benchmarks.study_figures.study import (
    BLACK,
    BLUE,
    GREEN,
    NAMES,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    Finding,
    Study,
    Verdict,
    edge,
    label,
    legend_below,
    panels,
    row_times,
    verdict,
)
from reactorwatch.process.library.cstr import OPERATING_COOLANT_FLOW
from reactorwatch.process.steady_state import StepComparison, compare_step

_STEP_FLOWS = {85.0: BLUE, 90.0: GREEN, 95.0: PURPLE, 100.0: ORANGE, 105.0: VERMILION, 110.0: BLACK}
_STEP = 1.0  # l/min
_STEP_SPAN_MIN, _BEFORE_MIN, _STEP_PERIOD_MIN = 20.0, 0.5, 0.005
_SHOWN_MIN = 8.0
_VISIBLE = 0.5  # % of the change: a smaller overshoot cannot be seen in a plot


def step_responses(study: Study, drawing: Drawing) -> Finding:
    """C and T after a step that ends at each flow."""
    axes_of = dict(zip("CT", panels(drawing, 2, 1, sharex=True), strict=True))
    time_min = row_times(round((_STEP_SPAN_MIN + _BEFORE_MIN) / _STEP_PERIOD_MIN) + 1, _STEP_PERIOD_MIN) - _BEFORE_MIN
    shown = time_min <= _SHOWN_MIN
    overshoots, rows = {}, []
    for flow, colour in _STEP_FLOWS.items():
        start, end = study.operating(flow - _STEP), study.operating(flow)
        inputs = flow - _STEP + np.where(time_min >= -1e-9, _STEP, 0.0)
        share = (study.simulator.run(time_min, inputs, start.state).states - start.state) / (end.state - start.state)
        overshoots[flow] = 100 * np.maximum(share.max(axis=0) - 1, 0.0)
        for index, name in enumerate("CT"):
            axes_of[name].plot(time_min[shown], 100 * share[shown, index], color=colour, label=f"to {flow:g} l/min")
        poles = end.eigenvalues
        named = (
            ", ".join(f"{pole.real:.2f}" for pole in np.sort_complex(poles))
            if np.all(poles.imag == 0)
            else f"{poles[0].real:.2f} +- {abs(poles[0].imag):.2f}i"
        )
        rows.append(f"| {flow:g} | {named} | {overshoots[flow][0]:.1f} % | {overshoots[flow][1]:.1f} % |")
    for name, axes in axes_of.items():
        label(
            axes,
            "minutes after the step" if name == "T" else "",
            f"change of {NAMES[name].split(',')[0]}, % of its end",
        )
    legend_below(drawing, axes_of["C"], 6)
    turn = edge(lambda flow: bool(np.all(study.operating(flow).eigenvalues.imag == 0)), 80.0, 100.0)
    smooth = [flow for flow in _STEP_FLOWS if overshoots[flow][0] < _VISIBLE]
    swinging = [flow for flow in _STEP_FLOWS if flow not in smooth]
    text = (
        f"Steps of {_STEP:+g} l/min that end at each flow:\n\n"
        "| flow, l/min | poles there, 1/min | overshoot of C | overshoot of T |\n|---|---|---|---|\n"
        + "\n".join(rows)
        + f"\n\nC shows no overshoot at {' and '.join(f'{flow:g}' for flow in smooth)} l/min, and at "
        f"{', '.join(f'{flow:g}' for flow in swinging)} l/min it does. But no response is of first order: the plant "
        f"has two states, and two real poles up to {turn:.1f} l/min; beyond, the poles are a complex pair. The "
        "oscillation "
        "that the report sees from 100 l/min on begins earlier and grows steadily; at 95 l/min it is too small to be "
        "seen at a plot's scale."
    )
    right = {85.0, 90.0} <= set(smooth) and {100.0, 105.0, 110.0} <= set(swinging)
    return Finding(text, Verdict.IN_PART if right else Verdict.DISAGREES)


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


def steady_state_curve(study: Study, drawing: Drawing) -> Finding:
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


FLOW = 100.0
"""l/min: flow at which the linear model is made."""
FLOWS = (85.0, 100.0, 110.0)
_UNIT = 1.0  # l/min
_RUN_MIN, _RUN_PERIOD_MIN = 8.0, 0.02
_ACCURATE = 5.0  # % of the change


def compare_linear(study: Study, drawing: Drawing) -> Finding:
    """Figure 10: the linear model after steps to other flows."""
    axes = panels(drawing, 2, 3, sharex=True)
    rows, steady = [], {}
    for column, flow in enumerate(FLOWS):
        # At 100 l/min itself there is nothing to compare_linear at rest, so the unit step stands for it.
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
        f"the linear model is wrong at rest, after {_RUN_MIN:g} min, and (root mean square) over these minutes:\n\n"
        "| step, l/min | at rest: C | at rest: T | at the end: C | at the end: T | overall: C | overall: T |\n"
        "|---|---|---|---|---|---|---|\n" + "\n".join(rows) + "\n\n"
        "That a large step is not followed is right. That the linear model is accurate after a short time is not: its "
        f"error does not fade, for the gain of the plant differs from that at {FLOW:g} l/min. At rest it is up to "
        f"{worst['C']:.0f} % of the change in C and {worst['T']:.0f} % in T. Accurate it is near the flow at which it "
        "was made, as the report concludes."
    )
    return Finding(text, Verdict.IN_PART if worst["C"] > _ACCURATE else Verdict.AGREES)


def unit_step(study: Study, drawing: Drawing, name: str) -> Finding:
    """Figures 8 and 9: an output after a unit step."""
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
        f"mean square) over {_RUN_MIN:g} min.\n\nThe report's operating point, {FLOW:g} l/min with {REPORTED_T:g} K, "
        "is no "
        f"steady state of its equations: at {FLOW:g} l/min the reactor rests "
        f"{point.outputs[1] - other.outputs[1]:.2f} K "
        f"higher, and {REPORTED_T:g} K belongs to {OPERATING_COOLANT_FLOW:g} l/min (figure 4)."
    )
    return Finding(text, verdict(bool(largest < _ACCURATE)))


def _compare(study: Study, step: float) -> StepComparison:
    point, flow = study.operating(FLOW).state, np.array([FLOW])
    return compare_step(study.model, point, flow, np.array([step]), _RUN_MIN, _RUN_PERIOD_MIN)


def _steady_change(study: Study, step: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Change of the linear model's outputs at rest after a step, shape (n_y,)."""
    from reactorwatch.process.steady_state import linearise

    linear = linearise(study.model, study.operating(FLOW).state, np.array([FLOW]))
    return np.asarray((linear.D - linear.C @ np.linalg.solve(linear.A, linear.B)) @ np.array([step]))


_STARTS = [(C, T) for C in (0.02, 0.2, 0.4, 0.6, 0.8, 0.98) for T in (345.0, 375.0, 405.0, 435.0, 465.0)]
_SPAN_MIN, _PERIOD_MIN = 20.0, 0.02
_ARRIVED = np.array([0.005, 0.5])  # mol/l and K


def phase_plane(study: Study, drawing: Drawing) -> Finding:
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
