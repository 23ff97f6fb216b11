"""Where a filter begins: at the state that shows what is measured, very uncertain of it.

If all states can be read off the measurements, they are: Newton's method on the outputs, which settles at once where
these are the states themselves. If not, because a value is missing or a state has no sensor, the search begins at the
steady state whose outputs are nearest to what is measured, so that the state that does not show is one that goes with
the others: of the reactor's three steady states, that of the right branch.

The memory that effects bring along (`ProcessModel.at_rest`) is at rest to begin with, give or take its scale.
"""

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from reactorwatch.process.array_function import ArrayFunction
from reactorwatch.process.filter_step import output_function
from reactorwatch.process.memory import reset_function, rest_function
from reactorwatch.process.model import Array, ProcessModel
from reactorwatch.process.steady_state import SteadyState, steady_states

START_SD = 3.0
"""Standard deviation at the start of a state that no sensor shows, in its scales."""

START_SDS = 10.0
"""Standard deviation at the start of a state that a sensor shows, in those of the sensor: it may be an outlier."""

CORRECTIONS = 5


class Beginning:
    """Finds the state that a filter begins with.

    Args:
        model: of the plant.
    """

    def __init__(self, model: ProcessModel) -> None:
        own = model.without_memory()
        self._model = own
        self._outputs = ArrayFunction(output_function(own))
        self._lower = np.array([state.lower for state in own.states])
        self._upper = np.array([state.upper for state in own.states])
        self._where: tuple[float, ...] = ()
        self._points: list[SteadyState] = []
        self._wide = np.diag(np.square([START_SD * state.scale for state in own.states]))
        self._memory = np.array([state.scale * (state.name in model.at_rest) for state in model.states])
        self._completed = ArrayFunction(_with_derivative(rest_function(model)))
        self._begun = ArrayFunction(_with_derivative(reset_function(model)))

    def at(
        self,
        time_min: float,
        inputs: Sequence[float],
        measured: Sequence[float],
        measurement_sd: Sequence[float],
        changes: Mapping[str, float],
    ) -> tuple[Array, Array] | None:
        """The state and its covariance; None if nothing is measured.

        Args:
            time_min: of the row.
            inputs: that hold from this row on.
            measured: one an output; NaN: missing.
            measurement_sd: of the sensors.
            changes: parameters that differ from the model's values.
        """
        y, u = np.asarray(measured, dtype=float), np.asarray(inputs, dtype=float)
        known = np.isfinite(y)
        if not known.any() or not np.all(np.isfinite(u)):
            return None
        model = self._model.with_values(changes) if changes else self._model
        p, wide = model.values(), self._wide
        R = np.diag(np.square(measurement_sd))[np.ix_(known, known)]
        x = 0.5 * (self._lower + self._upper)
        for argument, value in zip(self._outputs.arguments[1:], (u, p, np.array([time_min])), strict=True):
            argument[0] = value
        if np.linalg.matrix_rank(self._shown(x)[1][known]) < x.size:
            points = self._steady_states(model, u, time_min)
            distances = [float(np.nansum(((point.outputs - y) / measurement_sd) ** 2)) for point in points]
            x = points[int(np.argmin(distances))].state if points else x
        for _ in range(CORRECTIONS):
            expected, H = self._shown(x)
            K = _gain(wide, H[known], R)
            x = np.clip(x + K @ (y - expected)[known], self._lower, self._upper)
        H = self._shown(x)[1][known]
        K = _gain(wide, H, START_SDS**2 * R)
        rest = np.eye(x.size) - K @ H
        return self._with_memory(x, u, p, time_min, rest @ wide @ rest.T + START_SDS**2 * K @ R @ K.T)

    def _with_memory(self, x: Array, u: Array, p: Array, time_min: float, P: Array) -> tuple[Array, Array]:
        """The same with the states that nobody measures at rest, give or take their scales."""
        for function, further in ((self._completed, np.diag(np.square(self._memory))), (self._begun, 0.0)):
            for argument, value in zip(function.arguments, (x, u, p, np.array([time_min])), strict=True):
                argument[0] = value
            function()
            J = function.results[1].T
            x, P = function.results[0][0].copy(), J @ P @ J.T + further
        return x, P

    def _steady_states(self, model: ProcessModel, u: Array, time_min: float) -> list[SteadyState]:
        """As they are now. Kept until they are asked for elsewhere: one record is often begun many times."""
        where = (time_min, *u, *model.values())
        if where != self._where:
            self._where, self._points = where, steady_states(model, u, time_min)
        return self._points

    def _shown(self, x: Array) -> tuple[Array, Array]:
        """The outputs of a state, and their derivatives with respect to it, with the other arguments as they are."""
        outputs = self._outputs
        outputs.arguments[0][0] = x
        outputs()
        return outputs.results[0][0].copy(), outputs.results[1].T.copy()


def _with_derivative(function: ca.Function) -> ca.Function:
    """Of one vector of results, with the derivative by the first argument."""
    symbols = function.sx_in()
    result = function(*symbols)
    return ca.Function(function.name(), symbols, [result, ca.densify(ca.jacobian(result, symbols[0]))])


def _gain(P: Array, H: Array, R: Array) -> Array:
    """Of a correction. Far from where it runs, a model may have outputs that grow without bound: they tell little."""
    with np.errstate(over="ignore", invalid="ignore"):
        S, shown = H @ P @ H.T + R, H @ P
    if not np.all(np.isfinite(S)):
        return np.zeros((P.shape[0], H.shape[0]))
    try:
        return np.asarray(np.linalg.solve(S, shown).T, dtype=np.float64)
    except np.linalg.LinAlgError:  # beside the largest of them the noise of the sensors is lost
        return np.asarray((np.linalg.pinv(S, hermitian=True) @ shown).T, dtype=np.float64)
