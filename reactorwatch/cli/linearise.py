"""`linearise`: linear models of a process at constant inputs, and their error in a step response."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.steady_state import SteadyState, compare_step, linearise, steady_states


def describe(model: ProcessModel, levels: Sequence[float], step: float | None, *, as_json: bool) -> str:
    """Format all steady states at constant inputs with their linear models."""
    if len(levels) != len(model.inputs):
        raise InputError(
            f"{model.name}: one level for each input is needed ({', '.join(model.input_names)}), got {len(levels)}"
        )
    if step == 0:
        raise InputError("--step must not be 0")
    steps = {item.name: 0.1 * item.scale if step is None else step for item in model.inputs}
    for item, level in zip(model.inputs, levels, strict=True):
        for name, value in ((item.name, level), (f"{item.name} + step", level + steps[item.name])):
            if not item.lower <= value <= item.upper:
                raise InputError(f"{name} must be in [{item.lower:g}, {item.upper:g}] {item.unit}, got {value:g}")
    inputs = np.array(levels, dtype=float)
    points = [_point(model, point, inputs, steps) for point in steady_states(model, inputs)]
    if as_json:
        return msgspec.json.encode(
            {**dict(zip(model.input_names, levels, strict=True)), "steady_states": points}
        ).decode()
    given = ", ".join(f"{item.name} = {level:g} {item.unit}" for item, level in zip(model.inputs, levels, strict=True))
    plural = "" if len(points) == 1 else "s"
    return f"{len(points)} steady state{plural} at {given}\n" + "".join(_text(model, point, steps) for point in points)


def _point(model: ProcessModel, point: SteadyState, inputs: Array, steps: dict[str, float]) -> dict[str, Any]:
    linear = linearise(model, point.state, inputs)
    return {
        "state": dict(zip(model.state_names, point.state.tolist(), strict=True)),
        "kind": point.kind,
        "stable": point.stable,
        "eigenvalues_per_min": [[value.real, value.imag] for value in linear.eigenvalues.tolist()],
        "A": linear.A.tolist(),
        "B": linear.B.tolist(),
        "C": linear.C.tolist(),
        "D": linear.D.tolist(),
        "step_error": _step_errors(model, point, inputs, steps) if point.stable else None,
    }


def _step_errors(model: ProcessModel, point: SteadyState, inputs: Array, steps: dict[str, float]) -> dict[str, Any]:
    """Errors by output; of a process with several inputs by input and output."""
    found = {}
    for index, name in enumerate(model.input_names):
        step = np.zeros(inputs.size)
        step[index] = steps[name]
        error = compare_step(model, point.state, inputs, step).error.tolist()
        found[name] = dict(zip(model.output_names, error, strict=True))
    return found if len(found) > 1 else next(iter(found.values()))


def _text(model: ProcessModel, point: dict[str, Any], steps: dict[str, float]) -> str:
    states = ", ".join(f"{item.name} = {point['state'][item.name]:#.7g} {item.unit}" for item in model.states)
    eigenvalues = ", ".join(f"{re:.3f}{f' {im:+.3f}i' if im else ''}" for re, im in point["eigenvalues_per_min"])
    rows = [f"  {name} = {_matrix(point[name])}" for name in "ABCD"]
    lines = ["", f"{states}: {point['kind']}", f"  eigenvalues {eigenvalues} 1/min", *rows]
    errors = point["step_error"]
    several = len(model.inputs) > 1
    for item in model.inputs if errors is not None else ():
        by_output = errors[item.name] if several else errors
        parts = ", ".join(f"{name} {100 * value:.2g} %" for name, value in by_output.items())
        stepped = f"{steps[item.name]:g} {item.unit}{f' in {item.name}' if several else ''}"
        lines.append(f"  a step of {stepped}: linear model off the plant by {parts} of the response, over 10 min")
    return "\n".join(lines) + "\n"


def _matrix(rows: list[list[float]]) -> str:
    return "[" + "; ".join(" ".join(f"{value:.6g}" for value in row) for row in rows) + "]"
