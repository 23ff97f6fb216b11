"""Variables of the places along a path of the states."""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.law.shapes import Scale, bridge_gaps
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.places import Place, variable_expression


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
    values = _along(model, run, x, expressions)
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
    values = _along(model, run, x, [*expressions, *outputs, *rates])
    return {
        name: Scale(float(np.mean(item)), float(np.std(item)) or 1.0) for name, item in zip(names, values, strict=True)
    }


def _along(model: ProcessModel, run: Run, x: Array, expressions: Sequence[ca.SX]) -> Array:
    """Values of expressions along a path, shape (expressions, rows); gaps of the path are bridged."""
    symbols = [*model.arguments(), model.clock.now, model.clock.middle]
    function = ca.Function("along", symbols, [ca.densify(ca.vertcat(*expressions))])
    own = bridge_gaps(x[:, : len(model.states)]).T
    inputs, time = np.nan_to_num(run.inputs.T), run.time_min[None]
    return np.array(function(own, inputs, model.values(), time, time))
