"""Smooth corrections in a place: functions of its variables with a few linear coefficients, zero by default.

The functions are low powers, products and hinges of the variables, scaled by the record's own means and spreads, so
that coefficients of all places are of order one. The scales are parameters of the model, so that the machine code is
the same for every record. A sensor may also remember: its functions include the direction in which the output moves.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.kalman.ekf_step import MODEL_CACHE_SIZE
from reactorwatch.process.effect import Effect, ParameterShift
from reactorwatch.process.law import add_lag_states
from reactorwatch.process.model import Parameter, ProcessModel
from reactorwatch.process.places import CAPACITY, FACTOR, SENSOR, Place, correct, find_place, variable_expression

HINGES = (-0.7, 0.0, 0.7)
"""Positions of hinges, in spreads from the mean."""

QUICK = 3.0
"""Sharpness of the direction in which an output moves, in spreads of its rate."""

LARGEST = 1e12
"""Largest size of a coefficient."""

_BOUND = 1e6


@dataclass(frozen=True)
class Scale:
    """Mean and spread of a variable along the record."""

    mean: float
    spread: float


@dataclass(frozen=True, eq=False)
class Shape:
    """A model with smooth corrections.

    Attributes:
        place: the place.
        model: model with corrections, whose coefficients are parameters.
        parameters: names of the coefficients among the model's parameters.
        functions: functions of the correction as text, one for each coefficient.
        unit_size: correction at a unit coefficient of the constant function, the first one.
        terms: functions of the correction in the place itself as expressions.
        apart: functions of the correction apart from it; empty: none.
        scales: values of the model's parameters that scale the functions, by name.
    """

    place: Place
    model: ProcessModel
    parameters: tuple[str, ...]
    functions: tuple[str, ...]
    unit_size: float
    terms: tuple[ca.SX, ...]
    apart: tuple[ca.SX, ...] = ()
    scales: Mapping[str, float] = field(default_factory=dict)

    def lag_min(self, coefficients: Array) -> float:
        """Time constant with which the correction lags behind its variables; 0: none."""
        return self.place.lag_min * float(np.exp(coefficients[-1])) if self.place.lag_min else 0.0

    def corrections(self, x: Array, inputs: Array, coefficients: Array) -> Array:
        """Corrections along a path in the place, and apart from it if there are, shape (rows, 1 or 2)."""
        basis, n = self.basis(x, inputs), len(self.terms)
        columns = [basis[:, :n] @ coefficients[:n]]
        if self.apart:
            columns.append(basis[:, n:] @ coefficients[n : n + len(self.apart)])
        return np.column_stack(columns)

    def basis(self, x: Array, inputs: Array) -> Array:
        """Functions of the corrections along a path, shape (rows, functions), in their unit."""
        symbols = [*self.model.arguments(), self.model.clock.now, self.model.clock.middle]
        function = ca.Function("basis", symbols, [ca.vertcat(*self.terms, *self.apart)])
        none = np.zeros((1, len(x)))
        own = bridge_gaps(x[:, : len(self.model.states)])
        values = function(own.T, np.nan_to_num(inputs.T), self.model.values(self.scales), none, none)
        return np.asarray(self.unit_size * np.array(values).T)


def bridge_gaps(x: Array) -> Array:
    """A path without its gaps, in which no row is known; they are bridged by straight lines."""
    rows, known = np.arange(len(x)), np.flatnonzero(np.all(np.isfinite(x), axis=1))
    return x if known.size == rows.size else np.column_stack([np.interp(rows, known, item[known]) for item in x.T])


def make_shape(model: ProcessModel, place: Place, scales: Mapping[str, Scale]) -> Shape:
    """Add the corrections of a place to a model.

    Args:
        model: process model of the plant.
        place: one of its places.
        scales: scales of the variables by name; of an output's rate as `d(name)`.
    """
    built = _build(model, place.name)
    parts = (place, *([find_place(model, place.apart)] if place.apart else []))
    units = {f"law.{index}.unit": _typical(model, part, scales) for index, part in enumerate(parts)}
    values = {name: float(getattr(scales[of], what)) for name, (what, of) in built.scaled.items()}
    unit = _typical(model, place, scales)
    return replace(built.shape, unit_size=unit, scales=units | values)


@dataclass(frozen=True, eq=False)
class _Built:
    """Shape of a place without the scales of a record.

    Attributes:
        shape: the shape.
        scaled: for each parameter of a scale its kind, `mean` or `spread`, and the variable.
    """

    shape: Shape
    scaled: Mapping[str, tuple[str, str]]


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def _build(model: ProcessModel, name: str) -> _Built:
    """Build the shape of a place, once for all records, with everything that is compiled from its model."""
    place = find_place(model, name)
    parts = [_part(model, place, place.variables)]
    if place.apart:
        parts.append(_part(model, find_place(model, place.apart), place.variables, order=1))
    parameters: list[Parameter] = []
    names: list[str] = []
    coefficients: list[Parameter] = []
    scaled: dict[str, tuple[str, str]] = {}
    extended, terms, apart = model, list[ca.SX](), list[ca.SX]()
    lag = _constant("law.lag")
    for index, part in enumerate(parts):
        z, symbols = {}, list(part.arguments.values())
        if place.lag_min:
            lag_min = place.lag_min * ca.exp(lag.symbol)
            extended, symbols = add_lag_states(extended, lag_min, list(part.arguments), symbols)
        for name, expression in zip(part.arguments, symbols, strict=True):
            mean, spread = (_constant(f"law.{index}.{what}.{name}") for what in ("mean", "spread"))
            parameters += [mean, replace(spread, value=1.0)]
            scaled |= {mean.name: ("mean", name), spread.name: ("spread", name)}
            z[name] = (expression - mean.symbol) / spread.symbol
        correction = ca.SX(0)
        for text, function in _functions(part.place, z, part.order):
            coefficient = _constant(f"law.c{len(coefficients)}")
            coefficients.append(coefficient)
            names.append(text)
            correction += coefficient.symbol * function
            (apart if index else terms).append(function)
        size = _constant(f"law.{index}.unit")
        parameters.append(replace(size, value=1.0))
        extended = correct(extended, part.place, size.symbol * correction)
    if place.lag_min:
        coefficients.append(lag)
        names.append("logarithm of the lag's ratio")
    extended = replace(extended, parameters=(*extended.parameters, *parameters, *coefficients))
    chosen = tuple(item.name for item in coefficients)
    return _Built(Shape(place, extended, chosen, tuple(names), 1.0, tuple(terms), tuple(apart)), scaled)


@dataclass(frozen=True, eq=False)
class _Part:
    """A place with the expressions of its arguments."""

    place: Place
    arguments: Mapping[str, ca.SX]
    order: int


def _part(model: ProcessModel, place: Place, variables: Sequence[str], order: int = 2) -> _Part:
    arguments = {name: variable_expression(model, name) for name in variables}
    if place.kind == SENSOR:
        (output,) = (item for item in model.outputs if item.name == place.of)
        arguments[place.of] = output.expression
        slope = ca.mtimes(ca.jacobian(output.expression, model.arguments()[0]), ca.vertcat(*model.rhs))
        arguments[f"d({place.of})"] = slope
    return _Part(place, arguments, order)


def _functions(place: Place, z: Mapping[str, ca.SX], order: int) -> list[tuple[str, ca.SX]]:
    """Functions of a correction: powers, products and hinges, and for a sensor the direction of movement."""
    plain = [(name, item) for name, item in z.items() if not name.startswith("d(")]
    result = [("1", ca.SX(1)), *plain]
    if order > 1:
        result += [(f"{name}^2", item**2) for name, item in plain]
        result += [(f"{one[0]} {other[0]}", one[1] * other[1]) for one, other in combinations(plain, 2)]
        first, item = plain[0]
        if place.kind != CAPACITY:
            result.append((f"{first}^3", item**3))
            result += [(f"max({first} - {at:g}, 0)", ca.fmax(item - at, 0)) for at in HINGES]
    moving = [(name, item) for name, item in z.items() if name.startswith("d(")]
    result += [(f"{name}", item) for name, item in moving]
    result += [(f"direction of {name}", ca.tanh(QUICK * item)) for name, item in moving]
    return result


def _typical(model: ProcessModel, place: Place, scales: Mapping[str, Scale]) -> float:
    """Size of a correction at a unit coefficient."""
    if place.kind in (FACTOR, CAPACITY):
        return 0.1
    for item in (*model.states, *model.inputs):
        if item.name == place.of:
            return 0.1 * item.scale
    if place.of in scales:
        return 0.1 * scales[place.of].spread
    return 0.02 * abs(model.parameter(place.of).value) or 1.0


def _constant(name: str) -> Parameter:
    return Parameter(name, 0.0, "1", -LARGEST, LARGEST, "", ca.SX.sym(name))


def coefficient_effect(name: str) -> Effect:
    """Make an effect that shifts a parameter of the model."""

    class Coefficient(ParameterShift):
        """A coefficient of a correction."""

        label = name
        location = ""
        unit = "1"
        lower = -_BOUND
        upper = _BOUND
        typical = 0.1
        parameter = name

    Coefficient.name = name
    return Coefficient()
