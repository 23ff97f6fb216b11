"""Laws, and the places where they act: a missing term of the equations as a formula of states and inputs.

A place is a part of a process in which something unknown may act. A correction g, a function of states and inputs,
enters there in one of five ways:

| kind | enters | unit of g |
|---|---|---|
| source | dx/dt + g, for one state | of the state a minute |
| factor | every listed term of the balances times (1 + g) | 1 |
| capacity | dx/dt / (1 + g), for one state | 1 |
| input | u + g, for one input or parameter | of the input |
| sensor | y + g | of the output |

A term that occurs in several balances, such as a reaction with its heat, is one place: a correction acts on all of
them. So a place is recognised by what it does to each balance. A process declares its places (`ProcessModel.places`);
for one that does not, they follow from its equations.

A law is a form from a small library, of one or two variables, in a place. It is part of an extended model, like a
cause: `ExtendedLaw.extend` adds it. It holds in the range of its variables in which it was seen; outside of it the
formula is a guess, and `outside` says so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any, NamedTuple, cast

import casadi as ca
import msgspec
import numpy as np

from reactorwatch.process.model import Place, ProcessModel, parameter, variable

SOURCE, FACTOR, CAPACITY, INPUT, SENSOR = "source", "factor", "capacity", "input", "sensor"


def places_of(model: ProcessModel) -> tuple[Place, ...]:
    """Places of a model: the declared ones, or those that follow from its equations."""
    return model.places or _default_places(model)


def find_place(model: ProcessModel, name: str) -> Place:
    """Find a place by its name.

    Raises:
        ValueError: the model has no such place.
    """
    for place in places_of(model):
        if place.name == name:
            return place
    raise ValueError(f"{model.name} has no place {name!r} (it has {', '.join(item.name for item in places_of(model))})")


def correct(model: ProcessModel, place: Place, correction: ca.SX) -> ProcessModel:
    """Copy of a model with a correction in a place."""
    if place.kind == FACTOR:
        for state, term in place.flows.items():
            model = model.add_rate(state, correction * model.term(term))
        return model
    if place.kind == SOURCE:
        return model.add_rate(place.of, correction)
    if place.kind == CAPACITY:
        index = model.state_index(place.of)
        return replace(
            model, rhs=tuple(item / (1 + correction) if i == index else item for i, item in enumerate(model.rhs))
        )
    if place.kind == INPUT:
        symbols = {item.name: item.symbol for item in model.inputs}
        symbol = symbols[place.of] if place.of in symbols else model.parameter(place.of).symbol
        return model.substitute(symbol, symbol + correction)
    output = model.output(place.of)
    return model.with_output(replace(output, expression=output.expression + correction))


def unit_of(model: ProcessModel, place: Place) -> str:
    """Unit of a correction in a place."""
    if place.kind in (FACTOR, CAPACITY):
        return "1"
    unit = unit_of_variable(model, place.of)
    return f"{unit}/min" if place.kind == SOURCE else unit


def unit_of_variable(model: ProcessModel, name: str) -> str:
    """Unit of a state, input, output or parameter; 1 for a term."""
    units = {item.name: item.unit for item in model.parameters} | {item.name: item.unit for item in model.states}
    return (units | model.units).get(name, "1")


def variable_expression(model: ProcessModel, name: str) -> ca.SX:
    """Expression of a variable: a state, an input or a term."""
    for item in (*model.states, *model.inputs):
        if item.name == name:
            return item.symbol
    for output in model.outputs:
        if output.name == name:
            return output.expression
    return model.term(name)


def _default_places(model: ProcessModel) -> tuple[Place, ...]:
    """A source in each balance, an error of each input and of each sensor."""
    variables = (*model.states, *model.inputs)
    sources = tuple(
        Place(
            state.balance or state.name,
            state.balance or state.name,
            SOURCE,
            of=state.name,
            variables=tuple(item.name for item in variables if ca.depends_on(rate, item.symbol)) or (state.name,),
        )
        for state, rate in zip(model.states, model.rhs, strict=True)
        if state.name not in model.at_rest
    )
    inputs = tuple(Place(item.name, item.name, INPUT, of=item.name, variables=(item.name,)) for item in model.inputs)
    sensors = tuple(
        Place(f"{item.name} sensor", item.name, SENSOR, of=item.name, variables=(item.name,)) for item in model.outputs
    )
    return (*sources, *inputs, *sensors)


GAIN, SLOPE, CURVATURE, EXPONENT, RATE, POSITION = "gain", "slope", "curvature", "exponent", "rate", "position"
"""Kinds of a parameter, which give its unit: that of the correction, that over the variable's, and so on."""

APART = "h"
"""Parameter of a law with another place apart (`Place.apart`): the correction there, relative to the law's own."""

LAG = "lag"
"""Parameter of a law that lags behind its variables (`Place.lag_min`): its time constant."""


class FormParameter(NamedTuple):
    """A parameter of a form; `of` is the index of the variable whose unit it has."""

    name: str
    kind: str
    of: int = 0


@dataclass(frozen=True)
class Form:
    """A form of a law.

    Attributes:
        key: name of the form, unique.
        form: family in a diagnosis.
        parameters: parameters in order.
        expression: value from variables v, parameters p and references r, the variables' means.
        text: formula with `{v0}`, `{r0}` for variables and references, and the parameters' names.
        positive: whether the variables must be positive.
        symmetric: whether the order of the variables makes no difference.
        position: bounds of a position, as fractions of the variable's range from its smallest value; infinite: none.
    """

    key: str
    form: str
    parameters: tuple[FormParameter, ...]
    expression: Callable[[Sequence[Any], Any, Sequence[float]], Any]
    text: str
    positive: bool = False
    symmetric: bool = False
    position: tuple[float, float] = (-inf, inf)

    @property
    def variables(self) -> int:
        """Number of variables."""
        return 2 if "{v1}" in self.text else 1


def exponential(x: Any) -> Any:
    """Exponential of a number, an array or an expression, its argument limited."""
    return ca.exp(ca.fmin(x, 50.0)) if isinstance(x, ca.SX) else np.exp(np.minimum(x, 50.0))


def power(x: Any, exponent: Any) -> Any:
    """Power of a positive number, array or expression."""
    least = 1e-9
    log = ca.log(ca.fmax(x, least)) if isinstance(x, ca.SX) else np.log(np.maximum(x, least))
    return exponential(exponent * log)


def positive_part(x: Any) -> Any:
    """Larger of x and 0."""
    return ca.fmax(x, 0.0) if isinstance(x, ca.SX) else np.maximum(x, 0.0)


_A, _B, _C = FormParameter("a", GAIN), FormParameter("b", SLOPE), FormParameter("c", POSITION)
_D, _CURVE, _K = FormParameter("d", GAIN), FormParameter("a", CURVATURE), FormParameter("k", RATE)
_N, _M = FormParameter("n", EXPONENT), FormParameter("m", EXPONENT, 1)


def _exponential(v: Sequence[Any], p: Any, r: Sequence[float]) -> Any:
    return exponential(p[1] * (v[0] - r[0]))


def _power(v: Sequence[Any], p: Any, r: Sequence[float], i: int = 0) -> Any:
    return power(v[i] / r[i], p[i + 1])


FORMS: tuple[Form, ...] = (
    Form("constant", "constant", (_A,), lambda v, p, r: p[0] + 0.0 * v[0], "a"),
    Form("proportional", "linear", (_B,), lambda v, p, r: p[0] * v[0], "b {v0}"),
    Form("linear", "linear", (_A, _B), lambda v, p, r: p[0] + p[1] * (v[0] - r[0]), "a + b ({v0} - {r0})"),
    Form("difference", "difference", (_B, _C), lambda v, p, r: p[0] * (v[0] - p[1]), "b ({v0} - c)"),
    Form("power", "power", (_A, _N), lambda v, p, r: p[0] * _power(v, p, r), "a ({v0}/{r0})^n", positive=True),
    Form("square", "power", (_CURVE, _C), lambda v, p, r: p[0] * (v[0] - p[1]) ** 2, "a ({v0} - c)^2"),
    Form(
        "square and constant",
        "power",
        (_CURVE, _C, _D),
        lambda v, p, r: p[0] * (v[0] - p[1]) ** 2 + p[2],
        "a ({v0} - c)^2 + d",
    ),
    Form(
        "power and constant",
        "power",
        (_A, _N, _D),
        lambda v, p, r: p[0] * (_power(v, p, r) - 1.0) + p[2],
        "a (({v0}/{r0})^n - 1) + d",
        positive=True,
    ),
    Form(
        "exponential", "exponential", (_A, _K), lambda v, p, r: p[0] * _exponential(v, p, r), "a exp(k ({v0} - {r0}))"
    ),
    Form(
        "exponential and constant",
        "exponential",
        (_A, _K, _D),
        lambda v, p, r: p[0] * (_exponential(v, p, r) - 1.0) + p[2],
        "a (exp(k ({v0} - {r0})) - 1) + d",
    ),
    Form(
        "saturation",
        "saturation",
        (_A, _C),
        lambda v, p, r: p[0] * v[0] / (v[0] + positive_part(p[1])),
        "a {v0}/({v0} + c)",
        positive=True,
    ),
    *(
        Form(f"threshold {side}", "threshold", (_B, _C), expression, text, position=(0.0, 1.0))
        for side, expression, text in (
            ("above", lambda v, p, r: p[0] * positive_part(v[0] - p[1]), "b max({v0} - c, 0)"),
            ("below", lambda v, p, r: p[0] * positive_part(p[1] - v[0]), "b max(c - {v0}, 0)"),
        )
    ),
    Form(
        "product of powers",
        "product",
        (_A, _N, _M),
        lambda v, p, r: p[0] * _power(v, p, r) * _power(v, p, r, 1),
        "a ({v0}/{r0})^n ({v1}/{r1})^m",
        positive=True,
        symmetric=True,
    ),
    Form(
        "product with exponential",
        "product",
        (_A, _K),
        lambda v, p, r: p[0] * _exponential(v, p, r) * v[1] / r[1],
        "a exp(k ({v0} - {r0})) {v1}/{r1}",
    ),
    Form(
        "product of exponential and power",
        "product",
        (_A, _K, _M),
        lambda v, p, r: p[0] * _exponential(v, p, r) * _power(v, p, r, 1),
        "a exp(k ({v0} - {r0})) ({v1}/{r1})^m",
    ),
    Form(
        "product with difference",
        "product",
        (_B, _C),
        lambda v, p, r: p[0] * (v[0] - p[1]) * v[1] / r[1],
        "b ({v0} - c) {v1}/{r1}",
    ),
)
"""The library of forms."""


def find_form(key: str) -> Form:
    """Find a form by its name.

    Raises:
        ValueError: there is no such form.
    """
    for form in FORMS:
        if form.key == key:
            return form
    raise ValueError(f"unknown form of a law {key!r} (valid: {', '.join(item.key for item in FORMS)})")


class ExtendedLaw(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A law in a place of a process, as it is stored.

    Attributes:
        place: name of the place.
        form: name of the form.
        variables: names of the variables.
        references: reference of each variable, a round number near its mean.
        parameters: values by name.
        range: smallest and largest value of each variable with which the law was seen.
    """

    place: str
    form: str
    variables: tuple[str, ...]
    references: tuple[float, ...]
    parameters: dict[str, float]
    range: dict[str, tuple[float, float]]

    def extend(self, model: ProcessModel) -> ProcessModel:
        """Add the law to a model; its parameters are named `law.a` and so on.

        Raises:
            ValueError: the model lacks the place or a variable, or there is no such form or other parameters.
        """
        form, place = find_form(self.form), find_place(model, self.place)
        names = (
            *(item.name for item in form.parameters),
            *((APART,) if place.apart else ()),
            *((LAG,) if place.lag_min else ()),
        )
        if set(self.parameters) != set(names) or not len(self.variables) == len(self.references) == form.variables:
            raise ValueError(f"a law of the form {self.form!r} must have {form.variables} variables and {names}")
        units, prefix = self.units(model), f"law_{len(model.laws) + 1}" if model.laws else "law"
        own = tuple(
            parameter(f"{prefix}.{name}", float(self.parameters[name]), units[name], (-1e12, 1e12), self.formula())
            for name in names
        )
        arguments = [variable_expression(model, name) for name in self.variables]
        if place.lag_min:
            model, arguments = add_lag_states(model, own[-1].symbol, self.variables, arguments)
        correction = form.expression(arguments, [item.symbol for item in own], self.references)
        extended = correct(model, place, correction)
        if place.apart:
            extended = correct(extended, find_place(model, place.apart), own[-1].symbol * correction)
        return replace(extended, parameters=(*extended.parameters, *own), laws=(*extended.laws, self))

    def formula(self) -> str:
        """Formula as text, with the names of its parameters."""
        form = find_form(self.form)
        names = {f"v{i}": name for i, name in enumerate(self.variables)}
        names |= {f"r{i}": f"{value:g}" for i, value in enumerate(self.references)}
        return form.text.format(**names)

    def units(self, model: ProcessModel) -> dict[str, str]:
        """Units of the parameters, by name."""
        unit = unit_of(model, find_place(model, self.place))
        form = find_form(self.form)
        units = {
            item.name: _unit(item.kind, unit, unit_of_variable(model, self.variables[item.of]))
            for item in form.parameters
        }
        return units | {APART: "1", LAG: "min"}

    def outside(self, values: Mapping[str, np.ndarray[Any, Any]]) -> list[str]:
        """Sentences about variables that leave the range in which the law was seen."""
        sentences = []
        for name, (low, high) in self.range.items():
            if name in values and values[name].size:
                least, most = float(np.nanmin(values[name])), float(np.nanmax(values[name]))
                margin = 0.05 * (high - low)  # a twentieth of the range is no departure
                if least < low - margin or most > high + margin:
                    sentences.append(
                        f"{name} goes from {least:.4g} to {most:.4g}; the law was seen from {low:.4g} to {high:.4g} "
                        "and need not hold outside"
                    )
        return sentences


def laws_of(model: ProcessModel) -> tuple[ExtendedLaw, ...]:
    """Laws that were added to a model."""
    return cast(tuple[ExtendedLaw, ...], model.laws)


def add_lag_states(
    model: ProcessModel, lag_min: ca.SX, names: Sequence[str], arguments: Sequence[ca.SX]
) -> tuple[ProcessModel, list[ca.SX]]:
    """Add a state that follows each argument with this time constant."""
    result = []
    for name, argument in zip(names, arguments, strict=True):
        state = variable(f"law.lag.{name}", unit_of_variable(model, name), (-1e9, 1e9), 1.0, f"{name}, lagging")
        model = model.with_state(state, (argument - state.symbol) / lag_min, at_rest=argument)
        result.append(state.symbol)
    return model, result


def _unit(kind: str, gain: str, of: str) -> str:
    if kind in (GAIN, EXPONENT):
        return gain if kind == GAIN else "1"
    if kind == POSITION or of == "1":
        return of if kind == POSITION else gain if kind in (SLOPE, CURVATURE) else "1"
    if kind == RATE:
        return f"1/({of})" if "/" in of else f"1/{of}"
    power_of = f"({of})" if "/" in of else of
    return f"{gain}/{power_of}" + ("^2" if kind == CURVATURE else "")
