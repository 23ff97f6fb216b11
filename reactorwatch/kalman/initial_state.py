"""Initial state of a filter: the state that explains the first measurements, with a wide covariance.

If the measurements determine all states, Newton's method on the outputs finds them, in one step where the outputs are
the states themselves. If not, because a value is missing or a state has no sensor, the search starts at the steady
state whose outputs are nearest to the measurements, so that the unmeasured state fits the others: of the reactor's
three steady states, that of the right branch.

The states that effects add (`ProcessModel.at_rest`) are at rest at first, with a standard deviation of their scale.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property, lru_cache
from math import inf

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.array_function import ArrayFunction
from reactorwatch.kalman.ekf_step import MODEL_CACHE_SIZE, output_function
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import reset_function, rest_function, with_derivatives
from reactorwatch.process.steady_state import SteadyState, SteadyStates

START_SD = 3.0
"""Initial standard deviation of a state that no sensor shows, in its scales."""

START_SDS = 10.0
"""Initial standard deviation of a measured state, in those of the sensor: the value may be an outlier."""

MAX_ITERATIONS = 5


class InitialState:
    """Estimates the initial state of a filter.

    Args:
        model: model of the plant.

    Attributes:
        searches: number of searches for steady states so far; each costs as much as thousands of rows.
    """

    def __init__(self, model: ProcessModel) -> None:
        self.searches = 0
        core = model.without_effect_states
        self._model = core
        self._outputs = ArrayFunction(output_function(core))
        self._correct = ArrayFunction(correction_function(core))
        self._lower = np.array([state.lower for state in core.states])
        self._upper = np.array([state.upper for state in core.states])
        outputs = core.output_names
        self._measured_states = [(i, outputs.index(name)) for i, name in enumerate(core.state_names) if name in outputs]
        self._point: tuple[object, ...] = ()
        self._steady: list[SteadyState] = []
        self._wide = np.diag(np.square([START_SD * state.scale for state in core.states]))
        self._rest_sd = np.array([state.scale * (state.name in model.at_rest) for state in model.states])
        self._complete, self._reset = (ArrayFunction(item) for item in _memory_functions(model))

    def estimate(
        self,
        time_min: float,
        inputs: Sequence[float],
        measured: Sequence[float],
        measurement_sd: Sequence[float],
        changes: Mapping[str, float],
    ) -> tuple[Array, Array] | None:
        """Estimate the state and its covariance; None if nothing is measured.

        Args:
            time_min: time of the row.
            inputs: inputs that hold from this row on.
            measured: one value an output; NaN: missing.
            measurement_sd: standard deviations of the sensors' noise.
            changes: parameters that differ from the model's values.
        """
        y, u = np.asarray(measured, dtype=float), np.asarray(inputs, dtype=float)
        present = np.isfinite(y)
        if not present.any() or not np.all(np.isfinite(u)):
            return None
        p = self._model.values(changes)
        x = self._guess(y)
        slope = self._outputs.call(x, u, p, time_min)[1].T[present]
        # far from the operating range a model may have no finite derivatives
        if not np.all(np.isfinite(slope)) or np.linalg.matrix_rank(slope) < slope.shape[1]:
            points = self._steady_states(u, time_min, changes)
            distances = [float(np.nansum(((point.outputs - y) / measurement_sd) ** 2)) for point in points]
            x = points[int(np.argmin(distances))].state if points else x
        noise, wide = np.square(measurement_sd), self._wide
        for _ in range(MAX_ITERATIONS):
            before, x = x, self._correct.call(x, u, p, time_min, y, noise, wide)[0][0]
            if np.array_equal(before, x):
                break
        P = self._correct.call(x, u, p, time_min, y, START_SDS**2 * noise, wide)[1]
        after, J = self._complete.call(x, u, p, time_min)
        return self.reset(after[0], J.T @ P @ J + np.diag(np.square(self._rest_sd)), u, p, time_min)

    def reset(self, x: Array, P: Array, u: Array, p: Array, time_min: float) -> tuple[Array, Array]:
        """State and covariance after the jumps (`ProcessModel.resets`) at a row from which on inputs u hold."""
        after, J = self._reset.call(x, u, p, time_min)
        return after[0], J.T @ P @ J

    def _guess(self, y: Array) -> Array:
        """Take a state from the sensor of its name; others are in the middle of their range."""
        x: Array = 0.5 * (self._lower + self._upper)
        for state, output in self._measured_states:
            if np.isfinite(y[output]):
                x[state] = min(max(y[output], self._lower[state]), self._upper[state])
        return x

    def _steady_states(self, u: Array, time_min: float, changes: Mapping[str, float]) -> list[SteadyState]:
        """Steady states at this point; cached, as one record is often started many times."""
        point = (time_min, *u, *changes.items())
        if point != self._point:
            self.searches += 1
            self._point, self._steady = point, self._search.at(u, time_min, changes)
        return self._steady

    @cached_property
    def _search(self) -> SteadyStates:
        return SteadyStates(self._model)


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def correction_function(model: ProcessModel) -> ca.Function:
    """(x, u, p, t, y, r, P) -> a state that explains y better than x does, and its covariance.

    y has NaN for missing values, r holds the variances of the sensors, and P is the covariance of an unknown state. Far
    from the operating range a model's outputs may grow without bound; they are then left out.
    """
    x, u, p = model.arguments()
    t, n_x, n_y = ca.SX.sym("t"), x.numel(), len(model.outputs)
    y, r, wide = ca.SX.sym("y", n_y), ca.SX.sym("r", n_y), ca.SX.sym("P", n_x, n_x)
    lower, upper = (ca.DM([getattr(state, name) for state in model.states]) for name in ("lower", "upper"))
    expected, H = output_function(model)(x, u, p, t)
    change, P = ca.SX.zeros(n_x), wide
    for i in range(n_y):
        h = H[i, :]
        variance = h @ P @ h.T + r[i]
        informative = ca.logic_and(ca.fabs(y[i]) < inf, ca.fabs(variance) < inf)
        K = ca.if_else(informative, P @ h.T / variance, 0)
        change += ca.if_else(informative, K * (y[i] - expected[i] - h @ change), 0)
        I_KH = ca.SX.eye(n_x) - K @ ca.if_else(informative, h, 0)
        P = I_KH @ P @ I_KH.T + K @ K.T * r[i]
    after = ca.fmin(ca.fmax(x + change, lower), upper)
    return ca.Function("corrected", [x, u, p, t, y, r, wide], [after, ca.densify(P)])


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def _memory_functions(model: ProcessModel) -> tuple[ca.Function, ca.Function]:
    """`rest_function` and `reset_function`, with their derivatives."""
    return with_derivatives(rest_function(model), 0), with_derivatives(reset_function(model), 0)
