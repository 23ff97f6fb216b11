"""Variables of the places along a path of the states."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.law import variable_expression
from reactorwatch.process.model import Place, ProcessModel


@dataclass(frozen=True)
class Scale:
    """Mean and spread of a variable along the record."""

    mean: float
    spread: float


def variables_along(model: ProcessModel, run: Run, x: Array, place: Place, lag_min: float = 0.0) -> dict[str, Array]:
    """Variables of a place along a path, by name, each of shape (rows,).

    Args:
        model: process model of the plant.
        run: the record.
        x: states along the path; further states may follow those of the model.
        place: the place.
        lag_min: time constant with which they lag behind; 0: none.
    """
    expressions = [variable_expression(model, name) for name in place.variables]
    values = evaluate_along(model, expressions, x, run.inputs, run.time_min)
    if lag_min:
        keep = np.exp(-np.diff(run.time_min) / lag_min)
        for column in values:
            for row in range(1, column.size):
                column[row] += keep[row - 1] * (column[row - 1] - column[row])
    return dict(zip(place.variables, values, strict=True))


def scales_along(model: ProcessModel, run: Run, x: Array, places: Sequence[Place]) -> dict[str, Scale]:
    """Scales of the variables of all places, of the outputs and of their rates, `d(name)`."""
    names = sorted({name for place in places for name in place.variables})
    expressions = [variable_expression(model, name) for name in names]
    outputs = [item.expression for item in model.outputs]
    rates = [ca.mtimes(ca.jacobian(item, model.arguments()[0]), ca.vertcat(*model.rhs)) for item in outputs]
    names += [*model.output_names, *(f"d({name})" for name in model.output_names)]
    values = evaluate_along(model, [*expressions, *outputs, *rates], x, run.inputs, run.time_min)
    return {
        name: Scale(float(np.mean(item)), float(np.std(item)) or 1.0) for name, item in zip(names, values, strict=True)
    }


def evaluate_along(
    model: ProcessModel,
    expressions: Sequence[ca.SX],
    x: Array,
    inputs: Array,
    time_min: Array,
    changes: Mapping[str, float] | None = None,
) -> Array:
    """Values of expressions along a path, shape (expressions, rows); gaps of the path are bridged by straight lines.

    Args:
        model: process model of the expressions.
        expressions: scalars.
        x: states along the path; further states may follow those of the model.
        inputs: shape (rows, n_u).
        time_min: shape (rows,).
        changes: parameters that differ from the model's values.
    """
    symbols = [*model.arguments(), model.clock.now, model.clock.middle]
    function = ca.Function("along", symbols, [ca.densify(ca.vertcat(*expressions))])
    own, time = _bridge_gaps(x[:, : len(model.states)]).T, time_min[None]
    return np.array(function(own, np.nan_to_num(inputs.T), model.values(changes), time, time))


def _bridge_gaps(x: Array) -> Array:
    """Interpolate rows of a path in which no state is known."""
    rows, known = np.arange(len(x)), np.flatnonzero(np.all(np.isfinite(x), axis=1))
    return x if known.size == rows.size else np.column_stack([np.interp(rows, known, item[known]) for item in x.T])
