"""Smooth corrections in a place: functions of its variables with a few linear coefficients, zero by default.

The functions are low powers, products and hinges of the variables, scaled by the record's own means and spreads, so
that coefficients of all places are of order one. The scales are parameters of the model, so that the machine code is
the same for every record. A sensor may also remember: its functions include the direction in which the output moves,
unless a controller moves it in answer to the measurement (`find_answers`).

Inputs that a controller moves in answer to a measurement of the same row. Such an input has the measurement's noise in
it. A correction of the sensor that depends on the input would predict that noise, which no cause can, and would be
better than every explanation by thousands in BIC. In open loop what an input does in a row is independent of what is
measured in that row, given the rows before (the instantaneous causality of Granger 1969, Investigating causal relations
by econometric models and cross-spectral methods, Econometrica 37).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import combinations
from math import sqrt

import casadi as ca
import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.effect import Effect, ParameterShift
from reactorwatch.process.law import CAPACITY, FACTOR, SENSOR, add_lag_states, correct, find_place, variable_expression
from reactorwatch.process.model import MODEL_CACHE_SIZE, Parameter, Place, ProcessModel


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


ANSWERS = 6.0
"""Standard deviations by chance beyond which a correlation is an answer."""

LAGS = 2
"""Rows before that are given."""

Answers = frozenset[tuple[str, str]]
"""Pairs of an output and an input that answers to its measurement."""


def find_answers(model: ProcessModel, run: Run) -> Answers:
    """Find the inputs that answer to a measurement in the same row.

    Args:
        model: process model of the plant.
        run: the record.
    """
    rows = np.column_stack([run.inputs, run.measured])
    now, past = rows[LAGS:], np.hstack([rows[LAGS - lag : len(rows) - lag] for lag in range(1, LAGS + 1)])
    known = np.all(np.isfinite(now), axis=1) & np.all(np.isfinite(past), axis=1)
    past = np.column_stack([np.ones(np.count_nonzero(known)), past[known]])
    if len(past) <= 2 * past.shape[1]:
        return frozenset()
    scale = np.maximum(np.abs(past).max(axis=0), 1e-300)
    new = now[known] - past @ (np.linalg.lstsq(past / scale, now[known], rcond=None)[0] / scale[:, None])
    count = len(model.inputs)
    return frozenset(
        (output, name)
        for output, measured in zip(model.output_names, new[:, count:].T, strict=True)
        for name, moved in zip(model.input_names, new[:, :count].T, strict=True)
        if _correlation_in_sd(measured, moved) > ANSWERS
    )


def _correlation_in_sd(one: Array, other: Array) -> float:
    """Size of a correlation in standard deviations by chance; 0 where one of the two does not vary."""
    norm = float(np.linalg.norm(one) * np.linalg.norm(other))
    return abs(float(one @ other)) / norm * sqrt(one.size) if norm > 0.0 else 0.0


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
