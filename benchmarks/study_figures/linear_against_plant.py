"""Figures 9 to 11: the linear model at 85, 100 and 110 l/min against the plant."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from benchmarks.study_figures.canvas import BLUE, ORANGE, VERMILION, label, legend_below, panels
from benchmarks.study_figures.figure import Finding, verdict
from benchmarks.study_figures.study import NAMES, Study
from reactorwatch.process.step_response import compare_step

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

EIGENVALUES = {
    85.0: (-8.769, -2.987),
    100.0: (-1.983 - 3.059j, -1.983 + 3.059j),
    110.0: (-0.258 - 2.610j, -0.258 + 2.610j),
}
"""1/min, as the table that came with the description of the report has them, to three decimals."""

_DRAWN = {1.0: BLUE, 4.0: ORANGE, -4.0: VERMILION}
_TOLD = (0.5, 1.0, 2.0, 4.0, -4.0)


def claim(qc: float) -> str:
    """Claim of the figure at a flow in l/min."""
    return (
        "Taylor linearisation (A, B, C), compared with the plant; how well they agreed is not known. The description "
        f"gives the eigenvalues {_format_eigenvalues(np.array(EIGENVALUES[qc], dtype=complex))} 1/min."
    )


def at_85(study: Study, drawing: Drawing) -> Finding:
    """Figure 9."""
    return _compare(study, drawing, 85.0)


def at_100(study: Study, drawing: Drawing) -> Finding:
    """Figure 10."""
    return _compare(study, drawing, 100.0)


def at_110(study: Study, drawing: Drawing) -> Finding:
    """Figure 11."""
    return _compare(study, drawing, 110.0)


def _compare(study: Study, drawing: Drawing, qc: float) -> Finding:
    point = study.operating(qc)
    spans = dict.fromkeys("CT", (np.inf, -np.inf))
    axes_of = dict(zip("TC", panels(drawing, 2, 1, sharex=True), strict=True))
    errors, gone = {}, []
    for step in _TOLD:
        compared = compare_step(study.model, point, np.array([qc]), np.array([step]), span_min=8.0, period_min=0.02)
        errors[step] = 100 * compared.error
        last = point.outputs + compared.plant[-1]
        if last[1] < study.points(qc + step)[1].outputs[1]:
            gone.append(
                f"After {step:+g} l/min the plant leaves this branch and goes out (T = {last[1]:.0f} K after 8 min)."
            )
        colour = _DRAWN.get(step)
        for index, name in enumerate("CT"):
            if colour is None:
                continue
            drawn = point.outputs[index] + np.stack([compared.plant[:, index], compared.linear[:, index]])
            axes_of[name].plot(compared.time_min, drawn[0], color=colour, label=f"plant, {step:+g} l/min")
            axes_of[name].plot(compared.time_min, drawn[1], "--", color=colour, label=f"linear, {step:+g} l/min")
            spans[name] = (min(spans[name][0], drawn[1].min()), max(spans[name][1], drawn[1].max()))
    for name, (low, high) in spans.items():
        # Where the plant goes out, the rest would be a line: the picture shows what the linear model spans.
        axes_of[name].set_ylim(low - 0.4 * (high - low), high + 0.4 * (high - low))
    for name, axes in axes_of.items():
        label(axes, "minutes after the step" if name == "C" else "", NAMES[name])
    legend_below(drawing, axes_of["T"], 3)
    rows = "\n".join(f"| {step:+g} | {error[0]:.2g} % | {error[1]:.2g} % |" for step, error in errors.items())
    expected = np.array(EIGENVALUES[qc], dtype=complex)
    distance = float(np.max(np.abs(np.sort_complex(point.eigenvalues) - np.sort_complex(expected))))
    halving = [errors[1.0][index] / errors[0.5][index] for index in (0, 1)]
    text = (
        f"At {qc:g} l/min the reactor rests at C = {point.state[0]:.6f} mol/l, T = {point.state[1]:.4f} K, a "
        f"{point.kind}. Eigenvalues {_format_eigenvalues(point.eigenvalues)} 1/min; the table has "
        f"{_format_eigenvalues(expected)}, {distance:.4f} away at most.\n\nRoot mean square "
        "distance of the linear model from the plant over 8 min, as a share of the "
        f"plant's deviation:\n\n| step, l/min | C | T |\n|---|---|---|\n{rows}\n\nFrom 0.5 to 1 l/min these shares "
        f"grow {halving[0]:.2f} and {halving[1]:.2f} times; 2 is what the error of a first-order expansion comes to "
        f"as the step shrinks. {' '.join(gone)}"
    )
    return Finding(text, verdict(distance < 1e-3))


def _format_eigenvalues(values: NDArray[np.complex128]) -> str:
    if np.all(np.abs(values.imag) < 1e-12):
        return ", ".join(f"{value.real:.3f}" for value in np.sort_complex(values))
    return f"{values[0].real:.3f} +- {abs(values[0].imag):.3f}i"
