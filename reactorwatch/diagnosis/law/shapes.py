"""Smooth corrections in a place: functions of its variables with a few linear coefficients, zero by default.

The functions are low powers, products and hinges of the variables, scaled by the record's own means and spreads, so
that coefficients of all places are of order one. The scales are parameters of the model, so that the machine code is
the same for every record. A sensor may also remember: its functions include the direction in which the output moves,
unless a controller moves it in answer to the measurement (`feedback`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.law.feedback import Answers
from reactorwatch.diagnosis.law.path import Scale, evaluate_along
from reactorwatch.process.effect import Effect, ParameterShift
from reactorwatch.process.law import CAPACITY, FACTOR, SENSOR, add_lag_states, correct, find_place, variable_expression
from reactorwatch.process.model import MODEL_CACHE_SIZE, Parameter, Place, ProcessModel

HINGES = (-0.7, 0.0, 0.7)
"""Positions of hinges, in spreads from the mean."""

QUICK = 3.0
"""Sharpness of the direction in which an output moves, in spreads of its rate."""

LARGEST = 1e12
"""Largest size of a coefficient."""

_BOUND = 1e6


@dataclass(frozen=True, eq=False)
class Shape:
    """A model with smooth corrections.

    Attributes:
        place: the place.
        model: model with corrections, whose coefficients are parameters.
        parameters: names of the coefficients among the model's parameters.
        unit_size: correction at a unit coefficient of the constant function, the first one.
        terms: functions of the correction in the place itself as expressions.
        apart: functions of the correction apart from it; empty: none.
        scales: values of the model's parameters that scale the functions, by name.
    """

    place: Place
    model: ProcessModel
    parameters: tuple[str, ...]
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
        functions = (*self.terms, *self.apart)
        return self.unit_size * evaluate_along(self.model, functions, x, inputs, np.zeros(len(x)), self.scales).T


def make_shape(model: ProcessModel, place: Place, scales: Mapping[str, Scale], answers: Answers = frozenset()) -> Shape:
    """Add the corrections of a place to a model.

    Args:
        model: process model of the plant.
        place: one of its places.
        scales: scales of the variables by name; of an output's rate as `d(name)`.
        answers: inputs that answer to measurements: no correction of that sensor depends on them.
    """
    parts = (place, *([find_place(model, place.apart)] if place.apart else []))
    sensors = {part.of for part in parts if part.kind == SENSOR}
    # Places without a sensor that is answered have the shape, and its machine code, of a record in open loop.
    shape, scaled = _build(model, place.name, frozenset(pair for pair in answers if pair[0] in sensors))
    units = {f"law.{index}.unit": _typical(model, part, scales) for index, part in enumerate(parts)}
    values = {name: float(getattr(scales[of], what)) for name, (what, of) in scaled.items()}
    return replace(shape, unit_size=_typical(model, place, scales), scales=units | values)


@lru_cache(maxsize=MODEL_CACHE_SIZE)
def _build(model: ProcessModel, name: str, answers: Answers) -> tuple[Shape, Mapping[str, tuple[str, str]]]:
    """Shape of a place without the scales of a record, built once with everything that is compiled from its model.

    Also, for each parameter of a scale, its kind, `mean` or `spread`, and the variable.
    """
    place = find_place(model, name)
    if place.kind == SENSOR:
        known = [
            item for item in place.variables if not _answers(model, place, variable_expression(model, item), answers)
        ]
        place = replace(place, variables=tuple(known) or (place.of,))
    parameters: list[Parameter] = []
    coefficients: list[Parameter] = []
    scaled: dict[str, tuple[str, str]] = {}
    extended, terms, apart = model, list[ca.SX](), list[ca.SX]()
    lag = _constant("law.lag")
    for index, part in enumerate((place, *([find_place(model, place.apart)] if place.apart else []))):
        arguments = _arguments(model, part, place.variables, answers)
        z, symbols = {}, list(arguments.values())
        if place.lag_min:
            lag_min = place.lag_min * ca.exp(lag.symbol)
            extended, symbols = add_lag_states(extended, lag_min, list(arguments), symbols)
        for variable, expression in zip(arguments, symbols, strict=True):
            mean, spread = (_constant(f"law.{index}.{what}.{variable}") for what in ("mean", "spread"))
            parameters += [mean, replace(spread, value=1.0)]
            scaled |= {mean.name: ("mean", variable), spread.name: ("spread", variable)}
            z[variable] = (expression - mean.symbol) / spread.symbol
        correction = ca.SX(0)
        for function in _functions(part, z, order=1 if index else 2):
            coefficient = _constant(f"law.c{len(coefficients)}")
            coefficients.append(coefficient)
            correction += coefficient.symbol * function
            (apart if index else terms).append(function)
        size = _constant(f"law.{index}.unit")
        parameters.append(replace(size, value=1.0))
        extended = correct(extended, part, size.symbol * correction)
    if place.lag_min:
        coefficients.append(lag)
    extended = replace(extended, parameters=(*extended.parameters, *parameters, *coefficients))
    names = tuple(item.name for item in coefficients)
    return Shape(place, extended, names, 1.0, tuple(terms), tuple(apart)), scaled


def _arguments(model: ProcessModel, place: Place, variables: Sequence[str], answers: Answers) -> dict[str, ca.SX]:
    """Arguments of a correction by name; that of a sensor also depends on the output and its rate."""
    arguments = {name: variable_expression(model, name) for name in variables}
    if place.kind == SENSOR:
        (output,) = (item for item in model.outputs if item.name == place.of)
        arguments[place.of] = output.expression
        slope = ca.mtimes(ca.jacobian(output.expression, model.arguments()[0]), ca.vertcat(*model.rhs))
        if not _answers(model, place, slope, answers):
            arguments[f"d({place.of})"] = slope
    return arguments


def _answers(model: ProcessModel, place: Place, expression: ca.SX, answers: Answers) -> bool:
    """Return true if the expression depends on an input that answers to the measurement of the place's sensor."""
    return any((place.of, item.name) in answers and ca.depends_on(expression, item.symbol) for item in model.inputs)


def _functions(place: Place, z: Mapping[str, ca.SX], order: int) -> list[ca.SX]:
    """Functions of a correction: powers, products and hinges, and for a sensor the direction of movement."""
    plain = [item for name, item in z.items() if not name.startswith("d(")]
    moving = [item for name, item in z.items() if name.startswith("d(")]
    result = [ca.SX(1), *plain]
    if order > 1:
        result += [item**2 for item in plain]
        result += [one * other for one, other in combinations(plain, 2)]
        if place.kind != CAPACITY:
            result.append(plain[0] ** 3)
            result += [ca.fmax(plain[0] - at, 0) for at in HINGES]
    return [*result, *moving, *(ca.tanh(QUICK * item) for item in moving)]


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
