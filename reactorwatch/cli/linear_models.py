"""`linearise`: linear models of the reactor at a coolant flow, and their error in a step response."""

from typing import Any

import msgspec
import numpy as np

from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.linearise import linearise
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.steady_state import SteadyState, steady_states
from reactorwatch.process.step_response import compare_step


def describe(qc: float, step: float, *, as_json: bool) -> str:
    """Format all steady states at a flow with their linear models.

    Args:
        qc: coolant flow, l/min.
        step: step of the flow with which plant and linear model are compared at the stable states, l/min.
        as_json: format as a JSON object.

    Raises:
        InputError: a flow outside the valve's range.
    """
    model = cstr()
    valve = model.inputs[0]
    for name, value in (("qc", qc), ("qc + step", qc + step)):
        if not valve.lower <= value <= valve.upper:
            raise InputError(f"{name} must be in [{valve.lower:g}, {valve.upper:g}] {valve.unit}, got {value:g}")
    if step == 0:
        raise InputError("--step must not be 0")
    points = [_point(model, point, qc, step) for point in steady_states(model, np.array([qc]))]
    if as_json:
        return msgspec.json.encode({"qc": qc, "steady_states": points}).decode()
    return f"{len(points)} steady states at qc = {qc:g} l/min\n" + "".join(_text(point, step) for point in points)


def _point(model: ProcessModel, point: SteadyState, qc: float, step: float) -> dict[str, Any]:
    linear = linearise(model, point.state, np.array([qc]))
    error = compare_step(model, point, np.array([qc]), np.array([step])).error.tolist() if point.stable else None
    return {
        "state": dict(zip(model.state_names, point.state.tolist(), strict=True)),
        "kind": point.kind,
        "stable": point.stable,
        "eigenvalues_per_min": [[value.real, value.imag] for value in linear.eigenvalues.tolist()],
        "A": linear.A.tolist(),
        "B": linear.B.tolist(),
        "C": linear.C.tolist(),
        "D": linear.D.tolist(),
        "step_error": None if error is None else dict(zip(model.output_names, error, strict=True)),
    }


def _text(point: dict[str, Any], step: float) -> str:
    state = point["state"]
    eigenvalues = ", ".join(f"{re:.3f}{f' {im:+.3f}i' if im else ''}" for re, im in point["eigenvalues_per_min"])
    rows = [f"  {name} = {_matrix(point[name])}" for name in "ABCD"]
    lines = [
        "",
        f"C = {state['C']:.7f} mol/l, T = {state['T']:.4f} K: {point['kind']}",
        f"  eigenvalues {eigenvalues} 1/min",
        *rows,
    ]
    if point["step_error"] is not None:
        parts = ", ".join(f"{name} {100 * value:.2g} %" for name, value in point["step_error"].items())
        lines.append(f"  a step of {step:g} l/min: linear model off the plant by {parts} of the response, over 10 min")
    return "\n".join(lines) + "\n"


def _matrix(rows: list[list[float]]) -> str:
    return "[" + "; ".join(" ".join(f"{value:.6g}" for value in row) for row in rows) + "]"
