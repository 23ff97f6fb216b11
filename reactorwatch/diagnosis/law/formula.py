"""Find the formula of a missing term.

About the path of the smooth correction that explains the run best, the innovations are linear in the course of the
correction. So each form of the library is first fitted to them with one pass over the record a step, and only the best
ones are fitted inside the simulation, where they are compared by BIC.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from math import log
from typing import NamedTuple

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting import signatures
from reactorwatch.diagnosis.fitting.descent import Equations, descend
from reactorwatch.diagnosis.fitting.fault_filter import huber_weights
from reactorwatch.diagnosis.fitting.profiles import hat_functions
from reactorwatch.diagnosis.law.fit import ShapeFit
from reactorwatch.diagnosis.law.shapes import Shape
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.error_dynamics import ErrorDynamics
from reactorwatch.process.law import (
    APART,
    CURVATURE,
    EXPONENT,
    FORMS,
    GAIN,
    LAG,
    POSITION,
    RATE,
    SLOPE,
    ExtendedLaw,
    Form,
)
from reactorwatch.process.model import Place, ProcessModel

MOST_STARTS = 2
"""Starts of a form that are fitted further, the best with fitted linear parameters."""

STEPS = 12
"""Steps of a fit about a path."""

KNOTS = {1: 30, 2: 8}
"""Knots of each variable, by the number of variables."""

EXPONENTS = {1: (-2.0, 1.0, 4.0), 2: (-1.0, 3.0)}
"""Initial exponents, by the number of variables; and initial rates times the variable's mean."""

POSITIONS = (-1.0, 0.0, 1.0)
"""Initial positions, in spreads from the mean."""

_DIFFERENCE = 1e-4


class FormulaSearch:
    """Fits forms about the path of a smooth correction.

    A correction is represented by its values at knots of its variables, between which it is linear, so that the loss
    is a quadratic form of these values and a form is fitted in well under a millisecond.

    Args:
        fit: fit of the correction.
        dynamics: error equations about it.
        run: the record.
        variables: variables of the place along the path, each of shape (rows,).
    """

    def __init__(self, fit: ShapeFit, dynamics: ErrorDynamics, run: Run, variables: Mapping[str, Array]) -> None:
        self._place, self._dynamics, self._unit = fit.place, dynamics, fit.shape.unit_size
        self._lag_min = fit.lag_min
        self._variables = {name: item for name, item in variables.items() if np.ptp(item) > 0.0}
        self._charge = log(run.values)
        w = np.nan_to_num(fit.evaluation.w[2:])
        self._weights = np.sqrt(huber_weights(w)).ravel()
        free = fit.shape.corrections(fit.evaluation.innovations.x, run.inputs, fit.coefficients)
        self._apart, self._ratio, ratio = len(fit.shape.terms), 0.0, 0.0
        self._target = w.ravel() + self._response(free[:, :1])[:, 0]
        if free.shape[1] > 1:
            self._target += self._respond(free[:, 1:], self._apart)[:, 0]
            ratio = float(free[:, 0] @ free[:, 1]) / max(float(free[:, 0] @ free[:, 0]), 1e-300)
        self._ratio = ratio

    def candidates(self) -> list[tuple[float, ExtendedLaw]]:
        """Best fit of every form with every choice of variables with its predicted BIC, the best first."""
        result = []
        for count in (1, 2):
            for names in combinations(self._variables, count):
                if count > 1 and names[0] != next(iter(self._variables)):
                    continue  # the likeliest variable is one of two
                grid = self._grid(names)
                for form in FORMS:
                    if form.variables == count:
                        orders = [names] if form.symmetric else permutations(names)
                        result += [self._best(form, order, grid) for order in orders]
        return sorted((item for item in result if item is not None), key=lambda item: item[0])

    def _grid(self, names: Sequence[str]) -> "_Grid":
        """Quadratic form of the values at the knots of these variables."""
        values = [self._variables[name] for name in names]
        knots = [np.linspace(np.min(item), np.max(item), KNOTS[len(names)]) for item in values]
        hats = [
            hat_functions((item - at[0]) / (at[-1] - at[0]), at.size) for item, at in zip(values, knots, strict=True)
        ]
        basis = hats[0] if len(hats) == 1 else (hats[0][:, :, None] * hats[1][:, None, :]).reshape(len(hats[0]), -1)
        g = self._response(basis) * self._weights[:, None]
        target = self._target * self._weights
        points = [item.ravel() for item in np.meshgrid(*knots, indexing="ij")]
        variables = dict(zip(names, points, strict=True))
        means = {name: float(np.mean(item)) for name, item in zip(names, values, strict=True)}
        spreads = {name: float(np.std(item)) for name, item in zip(names, values, strict=True)}
        return _Grid(variables, means, spreads, g.T @ g, g.T @ target, 0.5 * float(target @ target))

    def _response(self, columns: Array) -> Array:
        """Reduction of the innovations by courses of the correction, shape (values, columns).

        A correction apart from the place is in proportion to that in it.
        """
        result = self._respond(columns, 0)
        return result + self._ratio * self._respond(columns, self._apart) if self._ratio else result

    def _respond(self, columns: Array, index: int) -> Array:
        """Reduction of the innovations by courses of a constant function's coefficient."""
        columns = columns / self._unit
        means = 0.5 * (columns[:-1] + columns[1:])
        g = signatures.forward_signatures(
            self._dynamics, index, np.ascontiguousarray(means[1:]), np.ascontiguousarray(columns[2:])
        )
        return np.asarray(g.reshape(-1, columns.shape[1]))

    def _best(self, form: Form, names: Sequence[str], grid: "_Grid") -> tuple[float, ExtendedLaw] | None:
        fitter = _FormFitter(form, names, grid)
        if form.positive and min(float(np.min(item)) for item in fitter.values) <= 0.0:
            return None
        starts = sorted((fitter.start(item) for item in fitter.starts()), key=lambda item: item.loss)[:MOST_STARTS]
        best = min((fitter.fit(item) for item in starts), key=lambda item: item.loss)
        if not (np.isfinite(best.loss) and fitter.is_in_bounds(best.p)):
            return None
        parameters = {item.name: float(value) for item, value in zip(form.parameters, best.p, strict=True)}
        if self._place.apart:
            parameters[APART] = self._ratio
        if self._place.lag_min:
            parameters[LAG] = self._lag_min
        values = [self._variables[name] for name in names]
        ranges = {name: (float(np.min(item)), float(np.max(item))) for name, item in zip(names, values, strict=True)}
        law = ExtendedLaw(self._place.name, form.key, tuple(names), tuple(fitter.references), parameters, ranges)
        return 2.0 * best.loss + len(parameters) * self._charge, law


@dataclass(frozen=True, eq=False)
class _Grid:
    """The loss as a quadratic form of the correction's values at the knots.

    Attributes:
        variables: values of each variable at the knots, shape (knots,).
        means: mean of each variable along the path.
        spreads: standard deviation of each variable along the path.
        information: curvature of the loss, shape (knots, knots).
        gradient: minus its slope where the correction is zero, shape (knots,).
        constant: its value where the correction is zero.
    """

    variables: Mapping[str, Array]
    means: Mapping[str, float]
    spreads: Mapping[str, float]
    information: Array
    gradient: Array
    constant: float

    def loss(self, course: Array) -> float:
        """The loss; infinite where the course is not finite."""
        if not np.all(np.isfinite(course)):
            return float("inf")
        return float(self.constant - self.gradient @ course + 0.5 * course @ self.information @ course)


class _FittedForm(NamedTuple):
    """Parameters of a form, with its course at the knots and its loss."""

    p: Array
    course: Array
    loss: float


class _FormFitter:
    """Fits a form of some variables to the values at the knots."""

    def __init__(self, form: Form, names: Sequence[str], grid: _Grid) -> None:
        self._form, self._grid = form, grid
        self.values = [grid.variables[name] for name in names]
        self._means, self._spreads = ([of[name] for name in names] for of in (grid.means, grid.spreads))
        self.references = [round_reference(*item) for item in zip(self._means, self._spreads, strict=True)]

    def _course(self, p: Array) -> Array:
        return np.asarray(self._form.expression(self.values, p, self.references))

    def starts(self) -> list[Array]:
        """Initial nonlinear parameters; gains follow from the first step."""
        starts, exponents = [np.zeros(len(self._form.parameters))], EXPONENTS[self._form.variables]
        for index, item in enumerate(self._form.parameters):
            mean, spread = self._means[item.of], self._spreads[item.of]
            options = {
                EXPONENT: exponents,
                RATE: [exponent / max(abs(mean), spread) for exponent in exponents],
                POSITION: [mean + position * spread for position in POSITIONS],
            }.get(item.kind, (0.0,))
            starts = [np.array([*start[:index], option, *start[index + 1 :]]) for start in starts for option in options]
        return starts

    def start(self, start: Array) -> _FittedForm:
        """Fit the linear parameters."""
        linear = [i for i, item in enumerate(self._form.parameters) if item.kind in (GAIN, SLOPE, CURVATURE)]
        columns = []
        with np.errstate(over="ignore", invalid="ignore"):
            for index in linear:
                unit = start.copy()
                unit[index] = 1.0
                columns.append(self._course(unit))
            g, p = np.column_stack(columns), start.copy()
            p[linear] = np.linalg.lstsq(g.T @ self._grid.information @ g, g.T @ self._grid.gradient, rcond=1e-12)[0]
            return self._evaluate(p)

    def fit(self, start: _FittedForm) -> _FittedForm:
        """Fit all parameters from a start."""
        with np.errstate(over="ignore", invalid="ignore"):
            return descend(start, self._normal_equations, lambda fit, step: self._evaluate(fit.p + step), STEPS)

    def _normal_equations(self, fit: _FittedForm) -> Equations:
        columns, grid = np.column_stack([self._slope(fit.p, i) for i in range(fit.p.size)]), self._grid
        return columns.T @ grid.information @ columns, columns.T @ (grid.gradient - grid.information @ fit.course)

    def _evaluate(self, p: Array) -> _FittedForm:
        course = self._course(p)
        return _FittedForm(p, course, self._grid.loss(course))

    def _slope(self, p: Array, i: int) -> Array:
        """Derivative of the course by a parameter."""
        item = self._form.parameters[i]
        spread = self._spreads[item.of]
        unit = {EXPONENT: 1.0, RATE: 1.0 / spread, POSITION: spread}.get(item.kind, max(abs(p[i]), 1e-9))
        low, high = p.copy(), p.copy()
        low[i] -= _DIFFERENCE * unit
        high[i] += _DIFFERENCE * unit
        return np.asarray((self._course(high) - self._course(low)) / (2.0 * _DIFFERENCE * unit))

    def is_in_bounds(self, p: Array) -> bool:
        """Return true if the positions of the form are where its formula differs from a simpler one."""
        for item, value in zip(self._form.parameters, p.tolist(), strict=True):
            low, high = float(np.min(self.values[item.of])), float(np.max(self.values[item.of]))
            share = (value - low) / (high - low)
            if item.kind == POSITION and not self._form.position[0] < share < self._form.position[1]:
                return False
        return True


def law_shape(model: ProcessModel, place: Place, law: ExtendedLaw) -> Shape:
    """Model with a law, as a shape whose coefficients shift the law's parameters."""
    extended = law.extend(model)
    names = extended.parameter_names[-len(law.parameters) :]
    return Shape(place, extended, names, 1.0, ())


def round_reference(mean: float, spread: float) -> float:
    """Round number near a mean: to the decimal below the spread.

    >>> round_reference(438.54, 4.2)
    440.0
    """
    if spread <= 0.0:
        return mean
    step = 10.0 ** np.floor(np.log10(4.0 * spread))
    rounded = float(np.round(mean / step) * step)
    return float(f"{rounded:.6g}") or mean
