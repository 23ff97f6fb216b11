"""Laws: a missing term of the equations as a formula of states and inputs.

A law is a form from a small library, of one or two variables, in a place of the process (`places`). It is part of an
extended model, like a cause: `ExtendedLaw.extend` adds it. It holds in the range of its variables in which it was seen;
outside of it the formula is a guess, and `outside` says so.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any, NamedTuple, cast

import casadi as ca
import msgspec
import numpy as np

from reactorwatch.process.model import ProcessModel, parameter, variable
from reactorwatch.process.places import correct, find_place, unit_of, unit_of_variable, variable_expression

GAIN, SLOPE, CURVATURE, EXPONENT, RATE, POSITION = "gain", "slope", "curvature", "exponent", "rate", "position"
"""Kinds of a parameter, which give its unit: that of the correction, that over the variable's, and so on."""

APART = "h"
"""Parameter of a law with another place apart (`Place.apart`): the correction there, relative to the law's own."""

LAG = "lag"
"""Parameter of a law that lags behind its variables (`Place.lag_min`): its time constant."""

MARGIN = 0.05
"""Fraction of a variable's range by which it may leave the range before `outside` says so."""


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
                margin = MARGIN * (high - low)
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
