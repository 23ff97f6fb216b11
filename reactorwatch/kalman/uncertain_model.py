"""A model with uncertain constants, disturbances that wander and coloured noise as further states of its filter.

A plant is never quite its model. What is not known about it is a state of the filter, so that its covariance is in the
variance of every prediction, and every row narrows it:

- A constant: the size of an effect of the catalogue, which never changes. Its standard deviation at first is a size of
  practical significance (`Effect.typical`). A move of the input to a point that the plant has not been at is then
  predicted with the variance that it deserves, and teaches (Schmidt 1966, Application of state-space methods to
  navigation problems, Advances in Control Systems 3; Friedland 1969, Treatment of bias in recursive filtering, IEEE
  Trans. Automatic Control 14).
- A disturbance of a balance that wanders: a first-order Gauss-Markov process, nearly a random walk.
- Coloured noise of a sensor: a first-order Gauss-Markov process that is added to its reading.

The effects of a catalogue are many, and most act nearly alike. `select_effects` takes the few whose combinations
come close to all others.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.codegen.array_function import ArrayFunction
from reactorwatch.kalman.ekf import NoiseLevels
from reactorwatch.kalman.ekf_step import MODEL_CACHE_SIZE
from reactorwatch.kalman.noise_estimation import initial_sensor_sd
from reactorwatch.process import effects_of, named_effects
from reactorwatch.process.effect import TIMING, Effect
from reactorwatch.process.model import Parameter, ProcessModel, parameter, variable
from reactorwatch.process.signal_effects import InputLag

CONSTANT, WANDER, NOISE = "constant", "wander", "noise"
"""Kinds of additional states: `constant feed_temperature`, `wander T`, `noise T`."""

MOST_CONSTANTS = 6
"""Number of effects without states that are uncertain at most; the lags of the inputs come on top."""

LEAST_RATE = 0.04
"""Rate that an effect must add to those selected before, root mean square, in scales of the states a minute."""

WANDER_MIN = 200.0
"""Time constant of a disturbance that wanders, in minutes: its variance stays finite where nothing is measured."""

LONGEST_NOISE_MIN = 60.0

_LAG_SHARE, _LEAST_LAG_SHARE = 0.3, 0.02
_WHITE_SHARE, _DRIVING_SHARES = 0.3, (2.0, 6.0, 20.0)  # of the noise by third differences, which see little of it
_POINTS, _SEED = 24, 7


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
        return widen_model(model, added).with_values(dict(zip(learned_parameters(added), values, strict=True)))
    effects = {item.name: item for item in named_effects(model)}
    for text in added:
        kind, name = text.split(" ", 1)
        if kind == CONSTANT:
            model = _add_constant(model, effects[name])
        elif kind == WANDER:
            model = _add_wander(model, name)
        else:
            model = _add_noise(model, name)
    return model


def learned_parameters(added: Sequence[str]) -> tuple[str, ...]:
    """Names of the parameters of the added states that are learned with the noise levels."""
    return tuple(f"{name}.memory_min" for kind, name in (item.split(" ", 1) for item in added) if kind == NOISE)


def noise_starts(
    model: ProcessModel, added: tuple[str, ...], measured: Array, smallest_sd: Sequence[float]
) -> list[NoiseLevels]:
    """Noise levels from which a search should start, too: all noise is coloured noise where there is such.

    Args:
        model: the model without what is added to it.
        added: see `widen_model`.
        measured: measurements, shape (rows, n_y); NaN where missing.
        smallest_sd: lower bounds of the sensors' noise.
    """
    coloured = [item.split(" ", 1)[1] for item in added if item.startswith(f"{NOISE} ")]
    if not coloured:
        return []
    sds = np.maximum([initial_sensor_sd(column) for column in measured.T], smallest_sd)
    by_name = dict(zip(model.output_names, sds.tolist(), strict=True))
    names = widen_model(model, added).state_names
    driving = np.array([by_name.get(name.removesuffix(".memory"), 0.0) * name.endswith(".memory") for name in names])
    sensors = tuple(_WHITE_SHARE * sd if name in coloured else sd for name, sd in by_name.items())
    return [NoiseLevels(sensors, tuple((share * driving).tolist())) for share in _DRIVING_SHARES]


def is_disturbance(text: str) -> bool:
    """True for a disturbance or coloured noise, False for an uncertain constant."""
    return not text.startswith(f"{CONSTANT} ")


def _add_constant(model: ProcessModel, effect: Effect) -> ProcessModel:
    size = f"{effect.name}.size"
    if size in model.parameter_names and f"{effect.name}.onset" not in model.parameter_names:
        return _add_offset(model, model.parameter(size), effect.typical)
    prefix, is_lag = effect.prefix(model), isinstance(effect, InputLag)
    lower, begin = effect.lower, effect.neutral
    if is_lag:  # at 0 a lag has no derivative
        lower, begin = _LEAST_LAG_SHARE * effect.typical, _LAG_SHARE * effect.typical
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
    return model.add_rate(name, state.symbol).with_state(state, -state.symbol / WANDER_MIN, ca.SX(0.0))


def _add_noise(model: ProcessModel, name: str) -> ProcessModel:
    """Add coloured noise to the reading of an output."""
    output = model.output(name)
    scale = model.states[model.state_index(name)].scale if name in model.state_names else 1.0
    reach = 100.0 * scale
    state = variable(f"{name}.memory", output.unit, (-reach, reach), 0.1 * scale, "coloured noise")
    time = parameter(f"{name}.memory_min", 1.0, "min", (0.03, LONGEST_NOISE_MIN), "time constant of the noise")
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
    while len(selected) < MOST_CONSTANTS and left.size:
        sizes = np.linalg.norm(left, axis=1)
        best = int(np.argmax(sizes))
        if sizes[best] < LEAST_RATE * np.sqrt(left.shape[1]):
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
    rng, points = np.random.default_rng(_SEED), []
    for _ in range(_POINTS):
        at, inputs = x + scales * rng.uniform(-1.0, 1.0, x.size), u + reach * rng.uniform(-1.0, 1.0, u.size)
        points.append(slopes.call(at, inputs, p, 0.0, 0.0, effect.neutral))
    of_rhs, of_y, F, H = (np.stack(items).transpose(0, 2, 1).copy() for items in zip(*points, strict=True))
    shown = np.linalg.pinv(H) @ of_y
    return np.asarray((effect.typical * (of_rhs - F @ shown)[:, :, 0] / scales).ravel())
