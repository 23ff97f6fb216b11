"""Where a filter begins: at the state that shows what is measured, very uncertain of it.

If all states can be read off the measurements, they are: Newton's method on the outputs, which settles at once where
these are the states themselves. If not, because a value is missing or a state has no sensor, the search begins at the
steady state whose outputs are nearest to what is measured, so that the state that does not show is one that goes with
the others: of the reactor's three steady states, that of the right branch.

The memory that effects bring along (`ProcessModel.at_rest`) is at rest to begin with, give or take its scale.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from math import inf

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.array_function import ArrayFunction
from reactorwatch.kalman.ekf_step import COMPILED, output_function
from reactorwatch.process.effect_states import reset_function, rest_function
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.steady_state import SteadyState, SteadyStates

START_SD = 3.0
"""Standard deviation at the start of a state that no sensor shows, in its scales."""

START_SDS = 10.0
"""Standard deviation at the start of a state that a sensor shows, in those of the sensor: it may be an outlier."""

CORRECTIONS = 5


class Beginning:
    """Finds the state that a filter begins with.

    Args:
        model: of the plant.

    Attributes:
        searches: number of searches for steady states so far, which cost as much as thousands of rows each.
    """

    def __init__(self, model: ProcessModel) -> None:
        self.searches = 0
        own = model.without_memory()
        self._model = own
        self._outputs = ArrayFunction(output_function(own))
        self._corrected = ArrayFunction(corrected_function(own))
        self._lower = np.array([state.lower for state in own.states])
        self._upper = np.array([state.upper for state in own.states])
        outputs = own.output_names
        self._named = [(place, outputs.index(name)) for place, name in enumerate(own.state_names) if name in outputs]
        self._where: tuple[object, ...] = ()
        self._points: list[SteadyState] = []
        self._wide = np.diag(np.square([START_SD * state.scale for state in own.states]))
        self._memory = np.array([state.scale * (state.name in model.at_rest) for state in model.states])
        completed, begun = _memory_functions(model)
        self._completed, self._begun = ArrayFunction(completed), ArrayFunction(begun)

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
        p = self._model.values(changes)
        x = self._guessed(y)
        if not _tells_all(self._slope(x, u, p, time_min)[known]):
            points = self._steady_states(u, time_min, changes)
            distances = [float(np.nansum(((point.outputs - y) / measurement_sd) ** 2)) for point in points]
            x = points[int(np.argmin(distances))].state if points else x
        noise, wide = np.square(measurement_sd), self._wide
        for _ in range(CORRECTIONS):
            before, x = x, _called(self._corrected, x, u, p, time_min, y, noise, wide)[0][0]
            if np.array_equal(before, x):
                break
        P = _called(self._corrected, x, u, p, time_min, y, START_SDS**2 * noise, wide)[1]
        return self._with_memory(x, u, p, time_min, P)

    def _with_memory(self, x: Array, u: Array, p: Array, time_min: float, P: Array) -> tuple[Array, Array]:
        """The same with the states that nobody measures at rest, give or take their scales."""
        after, J = _called(self._completed, x, u, p, time_min)
        return self.reset(after[0], J.T @ P @ J + np.diag(np.square(self._memory)), u, p, time_min)

    def reset(self, x: Array, P: Array, u: Array, p: Array, time_min: float) -> tuple[Array, Array]:
        """The state and its covariance when a row has begun, from which on inputs u hold: memory may jump then."""
        after, J = _called(self._begun, x, u, p, time_min)
        return after[0], J.T @ P @ J

    def _guessed(self, y: Array) -> Array:
        """Where a sensor has the name of a state, it shows about that; the others are in the middle of their range."""
        x: Array = 0.5 * (self._lower + self._upper)
        for state, output in self._named:
            if np.isfinite(y[output]):
                x[state] = min(max(y[output], self._lower[state]), self._upper[state])
        return x

    def _steady_states(self, u: Array, time_min: float, changes: Mapping[str, float]) -> list[SteadyState]:
        """As they are now. Kept until they are asked for elsewhere: one record is often begun many times."""
        where = (time_min, *u, *changes.items())
        if where != self._where:
            self.searches += 1
            self._where, self._points = where, self._rests.at(u, time_min, changes)
        return self._points

    @cached_property
    def _rests(self) -> SteadyStates:
        return SteadyStates(self._model)

    def _slope(self, x: Array, u: Array, p: Array, time_min: float) -> Array:
        """The outputs' derivatives with respect to the state."""
        return _called(self._outputs, x, u, p, time_min)[1].T


def _tells_all(slope: Array) -> bool:
    """Whether the state can be read off outputs with this derivative; far from where it runs a model has none."""
    return bool(np.all(np.isfinite(slope)) and np.linalg.matrix_rank(slope) == slope.shape[1])


def _called(function: ArrayFunction, *values: Array | float) -> list[Array]:
    for argument, value in zip(function.arguments, values, strict=True):
        argument[:] = value
    function()
    return [item.copy() for item in function.results]


@lru_cache(maxsize=COMPILED)
def corrected_function(model: ProcessModel) -> ca.Function:
    """(x, u, p, t, y, r, P) -> a state that shows y better than x does, and its covariance.

    With NaN in y for what is missing, r the variances of the sensors, and P the covariance of a state that nothing is
    known of. Far from where it runs, a model may have outputs that grow without bound: they tell nothing.
    """
    x, u, p = model.arguments()
    t, n_x, n_y = ca.SX.sym("t"), x.numel(), len(model.outputs)
    y, r, wide = ca.SX.sym("y", n_y), ca.SX.sym("r", n_y), ca.SX.sym("P", n_x, n_x)
    lower, upper = (ca.DM([getattr(state, name) for state in model.states]) for name in ("lower", "upper"))
    expected, H = output_function(model)(x, u, p, t)
    change, P = ca.SX.zeros(n_x), wide
    for place in range(n_y):
        h = H[place, :]
        variance = h @ P @ h.T + r[place]
        tells = ca.logic_and(ca.fabs(y[place]) < inf, ca.fabs(variance) < inf)
        K = ca.if_else(tells, P @ h.T / variance, 0)
        change += ca.if_else(tells, K * (y[place] - expected[place] - h @ change), 0)
        rest = ca.SX.eye(n_x) - K @ ca.if_else(tells, h, 0)
        P = rest @ P @ rest.T + K @ K.T * r[place]
    after = ca.fmin(ca.fmax(x + change, lower), upper)
    return ca.Function("corrected", [x, u, p, t, y, r, wide], [after, ca.densify(P)])


@lru_cache(maxsize=COMPILED)
def _memory_functions(model: ProcessModel) -> tuple[ca.Function, ca.Function]:
    """`rest_function` and `reset_function`, with their derivatives."""
    return _with_derivative(rest_function(model)), _with_derivative(reset_function(model))


def _with_derivative(function: ca.Function) -> ca.Function:
    """Of one vector of results, with the derivative by the first argument."""
    symbols = function.sx_in()
    result = function(*symbols)
    return ca.Function(function.name(), symbols, [result, ca.densify(ca.jacobian(result, symbols[0]))])
