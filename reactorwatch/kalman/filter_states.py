"""States of a filter: their initial estimate, and further states for what is uncertain about the plant.

The initial state explains the first measurements, with a wide covariance. If the measurements determine all states,
Newton's method on the outputs finds them, in one step where the outputs are the states themselves. If not, because a
value is missing or a state has no sensor, the search starts at the steady state whose outputs are nearest to the
measurements, so that the unmeasured state fits the others: of the reactor's three steady states, that of the right
branch. The states that effects add (`ProcessModel.at_rest`) are at rest at first, with a standard deviation of their
scale.

A plant is never quite its model. What is not known about it is a further state, so that its covariance is in the
variance of every prediction, and every row narrows it (`widen_model`):

- A constant: the size of an effect of the catalogue, which never changes. Its standard deviation at first is a size of
  practical significance (`Effect.typical`). A move of the input to a point that the plant has not been at is then
  predicted with the variance that it deserves, and teaches (Schmidt 1966, Application of state-space methods to
  navigation problems, Advances in Control Systems 3; Friedland 1969, Treatment of bias in recursive filtering, IEEE
  Trans. Automatic Control 14).
- A disturbance of a balance that wanders: a first-order Gauss-Markov process, nearly a random walk.
- An input that wanders about its recorded value: a first-order Gauss-Markov process whose time constant is learned. A
  pump that does so moves several balances, at once or through each other: the innovations are white together, and not
  only one by one.
- Coloured noise of a sensor: a first-order Gauss-Markov process that is added to its reading.

The effects of a catalogue are many, and most act nearly alike. `select_effects` takes the few whose combinations
come close to all others.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from math import inf

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.compiled_function import ArrayFunction
from reactorwatch.kalman.ekf_step import output_function
from reactorwatch.process import effects_of, named_effects
from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.model import MODEL_CACHE_SIZE, Parameter, ProcessModel, parameter, variable
from reactorwatch.process.signal_effects import InputLag
from reactorwatch.process.simulate import reset_function, rest_function, with_derivatives
from reactorwatch.process.steady_state import SteadyState, SteadyStates

CONSTANT, WANDER, NOISE = "constant", "wander", "noise"
"""Kinds of additional states: `constant feed_temperature`, `wander T`, `noise T`."""


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
        self._wide = np.diag(np.square([3.0 * state.scale for state in core.states]))  # of what no sensor shows
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
        for _ in range(5):  # Newton's method doubles its digits in each
            before, x = x, self._correct.call(x, u, p, time_min, y, noise, wide)[0][0]
            if np.array_equal(before, x):
                break
        # Ten standard deviations of the sensor: the value may be an outlier.
        P = self._correct.call(x, u, p, time_min, y, 100.0 * noise, wide)[1]
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


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def widen_model(model: ProcessModel, added: tuple[str, ...], values: tuple[float, ...] = ()) -> ProcessModel:
    """Add states to a model; the same object for the same states, with everything compiled from it.

    Args:
        model: the model.
        added: what each further state stands for, see `CONSTANT`, `WANDER` and `NOISE`.
        values: values of the `learned_parameters`; empty: those before learning.
    """
    if not added:
        return model
    if values:
        return widen_model(model, added).with_values(dict(zip(learned_parameters(model, added), values, strict=True)))
    effects = {item.name: item for item in named_effects(model)}
    for text in added:
        kind, name = text.split(" ", 1)
        if kind == CONSTANT:
            model = _add_constant(model, effects[name])
        elif kind == WANDER:
            model = _add_input_wander(model, name) if name in model.input_names else _add_wander(model, name)
        else:
            model = _add_noise(model, name)
    return model


def learned_parameters(model: ProcessModel, added: Sequence[str]) -> tuple[str, ...]:
    """Names of the parameters of the states added to a model that are learned with the noise levels."""
    names = []
    for kind, name in (item.split(" ", 1) for item in added):
        if kind == NOISE:
            names.append(f"{name}.memory_min")
        elif kind == WANDER and name in model.input_names:
            names.append(f"{name}.wander_min")
    return tuple(names)


def is_disturbance(text: str) -> bool:
    """True for a disturbance or coloured noise, False for an uncertain constant."""
    return not text.startswith(f"{CONSTANT} ")


def _add_constant(model: ProcessModel, effect: Effect) -> ProcessModel:
    size = f"{effect.name}.size"
    if size in model.parameter_names and f"{effect.name}.onset" not in model.parameter_names:
        return _add_offset(model, model.parameter(size), effect.typical)
    prefix, is_lag = effect.prefix(model), isinstance(effect, InputLag)
    lower, begin = effect.lower, effect.neutral
    if is_lag:
        lower, begin = 0.02 * effect.typical, 0.3 * effect.typical  # at 0 a lag has no derivative
    bounds = (lower, effect.upper)
    state = variable(f"{prefix}.constant", effect.unit, bounds, effect.typical, f"size of: {effect.label}")
    start = parameter(f"{prefix}.start", begin, effect.unit, bounds, f"expected size of: {effect.label}")
    model = effect.apply(model, state.symbol).with_state(state, ca.SX(0.0), start.symbol)
    return replace(model, parameters=(*model.parameters, start))


def _add_offset(model: ProcessModel, item: Parameter, sd: float) -> ProcessModel:
    """Add an offset of a parameter that the model has."""
    bounds = (item.lower - item.value, item.upper - item.value)
    state = variable(f"{item.name}.constant", item.unit, bounds, sd, f"offset of: {item.meaning}")
    start = parameter(f"{item.name}.start", 0.0, item.unit, bounds, f"expected offset of: {item.meaning}")
    model = model.substitute(item.symbol, item.symbol + state.symbol).with_state(state, ca.SX(0.0), start.symbol)
    return replace(model, parameters=(*model.parameters, start))


def _add_wander(model: ProcessModel, name: str) -> ProcessModel:
    """Add a disturbance of the balance of a state."""
    balance = model.states[model.state_index(name)]
    reach = 20.0 * balance.scale
    state = variable(f"{name}.wander", f"{balance.unit}/min", (-reach, reach), 0.1 * balance.scale, "disturbance")
    # With a time constant of 200 min its variance stays finite where nothing is measured.
    return model.add_rate(name, state.symbol).with_state(state, -state.symbol / 200.0, ca.SX(0.0))


def _add_input_wander(model: ProcessModel, name: str) -> ProcessModel:
    """Add a deviation of an input from its recorded value."""
    given = model.inputs[model.input_names.index(name)]
    reach = given.upper - given.lower
    state = variable(f"{name}.wander", given.unit, (-reach, reach), 0.1 * given.scale, "deviation from its record")
    time = parameter(f"{name}.wander_min", 1.0, "min", (1e-3, 1e5), "time constant of the deviation")
    model = model.substitute(given.symbol, given.symbol + state.symbol)
    model = model.with_state(state, -state.symbol / time.symbol, ca.SX(0.0))
    return replace(model, parameters=(*model.parameters, time))


def _add_noise(model: ProcessModel, name: str) -> ProcessModel:
    """Add coloured noise to the reading of an output."""
    output = model.output(name)
    scale = model.states[model.state_index(name)].scale if name in model.state_names else 1.0
    reach = 100.0 * scale
    state = variable(f"{name}.memory", output.unit, (-reach, reach), 0.1 * scale, "coloured noise")
    time = parameter(f"{name}.memory_min", 1.0, "min", (0.03, 60.0), "time constant of the noise")
    model = model.with_state(state, -state.symbol / time.symbol, ca.SX(0.0))
    shown = model.with_output(replace(output, expression=output.expression + state.symbol))
    return replace(shown, parameters=(*shown.parameters, time))


def select_effects(model: ProcessModel, x: Array, u: Array) -> tuple[str, ...]:
    """Names of a few effects whose combinations come close to the other effects that act without states.

    Effects are compared by the rates that they add to the balances at points around a usual one; the bias of a sensor
    by the rates that it pretends. The effect that adds most to those selected before is the next.

    Args:
        model: the model.
        x: usual states, shape (n_x,).
        u: usual inputs, shape (n_u,).
    """
    candidates, rows = [], []
    for effect, p, slopes in _slope_functions(model):
        rates = _rates(model, effect, ArrayFunction(slopes), p, x, u)
        if np.all(np.isfinite(rates)):
            candidates.append(effect.name)
            rows.append(rates)
    left = np.array(rows)
    selected: list[str] = []
    while len(selected) < 6 and left.size:  # the lags of the inputs come on top
        sizes = np.linalg.norm(left, axis=1)
        best = int(np.argmax(sizes))
        if sizes[best] < 0.04 * np.sqrt(left.shape[1]):  # in scales a minute (rms)
            break
        selected.append(candidates[best])
        direction = left[best] / sizes[best]
        left = left - np.outer(left @ direction, direction)
    lags = [item.name for item in effects_of(model) if isinstance(item, InputLag)]
    return (*selected, *lags)


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def _slope_functions(model: ProcessModel) -> tuple[tuple[Effect, Array, ca.Function], ...]:
    """Effects that act both ways, without states of their own, each with its parameters and derivatives.

    The derivatives are (x, u, p, t, t_middle, size) -> rates and outputs by the size, then by x.
    """
    result = []
    for effect in effects_of(model):
        if effect.is_discontinuous or effect.is_source or effect.location == TIMING or effect.delays_output:
            continue
        size = ca.SX.sym("m")
        try:
            extended = effect.apply(model, size)
        except ValueError:
            continue
        if len(extended.states) != len(model.states) or effect.constants or effect.lower >= effect.neutral:
            continue
        rhs, y = ca.vertcat(*extended.rhs), ca.vertcat(*(item.expression for item in extended.outputs))
        symbols = [*extended.arguments(), extended.clock.now, extended.clock.middle, size]
        by = [ca.jacobian(rhs, size), ca.jacobian(y, size), ca.jacobian(rhs, symbols[0]), ca.jacobian(y, symbols[0])]
        result.append((effect, extended.values(), ca.Function("slopes", symbols, by)))
    return tuple(result)


def _rates(model: ProcessModel, effect: Effect, slopes: ArrayFunction, p: Array, x: Array, u: Array) -> Array:
    """Rates in scales a minute that an effect of typical size adds, shape (points * n_x,)."""
    scales, reach = np.array([item.scale for item in model.states]), np.array([item.scale for item in model.inputs])
    rng, points = np.random.default_rng(7), []
    for _ in range(24):
        at, inputs = x + scales * rng.uniform(-1.0, 1.0, x.size), u + reach * rng.uniform(-1.0, 1.0, u.size)
        points.append(slopes.call(at, inputs, p, 0.0, 0.0, effect.neutral))
    of_rhs, of_y, F, H = (np.stack(items).transpose(0, 2, 1).copy() for items in zip(*points, strict=True))
    shown = np.linalg.pinv(H) @ of_y
    return np.asarray((effect.typical * (of_rhs - F @ shown)[:, :, 0] / scales).ravel())
