"""Profiles m(t) of a deviation in time, as functions that can be fitted.

A profile is a sum of basis functions of time with linear coefficients; nonlinear parameters, such as an onset, shape
the functions. Between two rows m acts on a process by its mean, a sensor shows its value at the row. So a deviation is
two signals: `interval_mean`, held from each row to the next, and `sample_value`. An onset between two rows changes the
mean, so the fit depends on it continuously.

Times are minutes of the plant. Parameters are named as in `reactorwatch.process.profiles`, so a fit can be put into a
model or into the plant.
"""

from abc import ABC, abstractmethod
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from math import atan2, cos, hypot, pi, sin
from typing import ClassVar, NamedTuple, Self

import numpy as np

from reactorwatch.arrays import Array
from reactorwatch.process.effect import EffectConstant

CONSTANT_SHARE = 0.01
"""Smallest step for derivatives by a constant of an effect, in standard deviations of its prior."""


class Signal(NamedTuple):
    """A deviation as signals, shape (rows,), or several, shape (rows, n).

    Attributes:
        interval_mean: mean from each row to the next; in the last row, the value there.
        sample_value: value at each row.
        constants: values of the effect's own constants; empty: the nominal ones.
    """

    interval_mean: Array
    sample_value: Array
    constants: tuple[float, ...] = ()


@dataclass(frozen=True)
class NonlinearParameter:
    """A parameter that shapes the basis functions, in minutes.

    Attributes:
        name: name in the profile.
        lower: smallest value.
        upper: largest value.
        difference: smallest step for numerical derivatives.
    """

    name: str
    lower: float
    upper: float
    difference: float


class FittedProfile(ABC):
    """A kind of profile over the rows of one record.

    Args:
        time_min: times of the rows, shape (rows,).

    Attributes:
        name: name of the profile.
        shape_names: names of the parameters that shape the basis functions.
        n_linear: number of basis functions.
        constants: constants of the effect's own, which are fitted after the parameters of the profile.
    """

    name: ClassVar[str]
    shape_names: ClassVar[tuple[str, ...]] = ()
    n_linear: int = 1
    constants: tuple[EffectConstant, ...] = ()

    def __init__(self, time_min: Array) -> None:
        self.time_min = time_min
        self.start_min, self.end_min = float(time_min[0]), float(time_min[-1])
        self.period_min = float(np.median(np.diff(time_min)))
        self._step = np.diff(time_min)

    @cached_property
    def nonlinear_parameters(self) -> tuple[NonlinearParameter, ...]:
        """Parameters that shape the basis functions."""
        period, span, shortest = self.period_min, self.end_min - self.start_min, 5.0 * self.period_min
        bounds = {
            "onset": (self.start_min, self.end_min - period, period / 2),
            "end": (self.start_min + 2.0 * period, self.end_min, period / 2),
            "time_constant": (shortest, 3.0 * span, 0.1 * shortest),
            "period": (4.0 * period, span, 1e-5 * span),
        }
        return tuple(NonlinearParameter(name, *bounds[name]) for name in self.shape_names)

    @property
    def n_shape(self) -> int:
        """Number of parameters of the profile itself."""
        return self.n_linear + len(self.nonlinear_parameters)

    @property
    def n_parameters(self) -> int:
        """Number of fitted parameters, the effect's constants included."""
        return self.n_shape + len(self.constants)

    def with_constants(self, constants: tuple[EffectConstant, ...]) -> Self:
        """Copy for an effect with these constants."""
        if constants == self.constants:
            return self
        other = copy(self)
        other.constants = constants
        return other

    def complete(self, parameters: Array) -> Array:
        """Parameters, with the nominal constants of the effect where they have none."""
        if parameters.size == self.n_parameters:
            return parameters
        return np.append(parameters[: self.n_shape], [item.value for item in self.constants])

    @abstractmethod
    def basis_functions(self, shape: Array) -> tuple[Array, Array]:
        """Basis functions and their integrals from the first row, each of shape (rows, n_linear)."""

    def profile_values(self, parameters: Array) -> dict[str, float]:
        """Parameter values of the profile by name, `size` first."""
        shape = zip(self.nonlinear_parameters, parameters[self.n_linear : self.n_shape].tolist(), strict=True)
        return {"size": float(parameters[0])} | {item.name: value for item, value in shape}

    def unit(self, name: str, unit_of_size: str) -> str:
        """Unit of a profile parameter."""
        if name.startswith("value"):
            return "1"
        return {"size": unit_of_size, "phase": "rad"}.get(name, "min")

    def basis_signals(self, shape: Array) -> Signal:
        """Basis functions as signals, shape (rows, n_linear), contiguous in memory."""
        return self._to_signal(shape) if self.nonlinear_parameters else self._fixed_basis

    @cached_property
    def _fixed_basis(self) -> Signal:
        """Basis of a profile without nonlinear parameters."""
        return self._to_signal(np.empty(0))

    def _to_signal(self, shape: Array) -> Signal:
        value, area = self.basis_functions(shape)
        interval_mean = np.append(np.diff(area, axis=0) / self._step[:, None], value[-1:], axis=0)
        return Signal(interval_mean, value)

    def signal(self, parameters: Array) -> Signal:
        """Deviation at these parameters: linear ones first, then nonlinear ones."""
        basis = self.basis_signals(parameters[self.n_linear :])
        by, constants = parameters[: self.n_linear], tuple(parameters[self.n_shape :].tolist())
        return Signal(basis.interval_mean @ by, basis.sample_value @ by, constants)

    def derivatives(self, parameters: Array, differences: Array) -> Signal:
        """Derivatives of the deviation by the parameters of the profile, shape (rows, n_shape).

        Args:
            parameters: linear, then nonlinear parameters.
            differences: steps for the nonlinear parameters and the constants, at least `difference_steps`.
        """
        basis = self.basis_signals(parameters[self.n_linear :])
        if not self.nonlinear_parameters:
            return basis
        columns = [basis]
        for index, (number, difference) in enumerate(
            zip(self.nonlinear_parameters, differences, strict=False), start=self.n_linear
        ):
            low, high = parameters.copy(), parameters.copy()
            low[index] = max(parameters[index] - difference, min(number.lower, parameters[index] - number.difference))
            high[index] = min(parameters[index] + difference, max(number.upper, parameters[index] + number.difference))
            before, after, step = self.signal(low), self.signal(high), high[index] - low[index]
            interval_mean = (after.interval_mean - before.interval_mean)[:, None] / step
            columns.append(Signal(interval_mean, (after.sample_value - before.sample_value)[:, None] / step))
        return Signal(
            np.concatenate([item.interval_mean for item in columns], axis=1),
            np.concatenate([item.sample_value for item in columns], axis=1),
        )

    @property
    def difference_steps(self) -> Array:
        """Smallest steps for derivatives by the nonlinear parameters, then by the constants."""
        shape = [number.difference for number in self.nonlinear_parameters]
        return np.array([*shape, *(CONSTANT_SHARE * item.sd for item in self.constants)])

    def clip(self, parameters: Array, lower: float, upper: float) -> Array:
        """Clip the parameters to their bounds."""
        result = parameters.copy()
        result[: self.n_linear] = self._clip_linear(parameters[: self.n_linear], lower, upper)
        for index, number in enumerate(self.nonlinear_parameters, start=self.n_linear):
            result[index] = min(max(result[index], number.lower), number.upper)
        for index, item in enumerate(self.constants, start=self.n_shape):
            result[index] = min(max(result[index], item.lower), item.upper)
        return result

    def _clip_linear(self, by: Array, lower: float, upper: float) -> Array:
        return np.clip(by, lower, upper)


class Constant(FittedProfile):
    """Constant deviation over the whole record."""

    name = "constant"

    def basis_functions(self, shape: Array) -> tuple[Array, Array]:
        """See `FittedProfile`."""
        return np.ones((self.time_min.size, 1)), self.time_min[:, None] - self.start_min


class Step(FittedProfile):
    """Step at the onset."""

    name = "step"
    shape_names = ("onset",)

    def basis_functions(self, shape: Array) -> tuple[Array, Array]:
        """See `FittedProfile`."""
        age = self.time_min - shape[0]
        return (age >= 0.0).astype(float)[:, None], np.maximum(age, 0.0)[:, None]


class Ramp(FittedProfile):
    """Linear growth from the onset to the end of the record."""

    name = "ramp"
    shape_names: ClassVar[tuple[str, ...]] = ("onset",)

    def basis_functions(self, shape: Array) -> tuple[Array, Array]:
        """See `FittedProfile`."""
        age, span = np.maximum(self.time_min - shape[0], 0.0), max(self.end_min - shape[0], self.period_min)
        return (age / span)[:, None], (0.5 * age**2 / span)[:, None]

    def profile_values(self, parameters: Array) -> dict[str, float]:
        """See `FittedProfile`."""
        values = super().profile_values(parameters)
        return values | {"end": values.get("end", self.end_min)}


class EndedRamp(Ramp):
    """Linear growth from the onset to an end, constant afterwards."""

    name = "ended_ramp"
    shape_names = ("onset", "end")

    def basis_functions(self, shape: Array) -> tuple[Array, Array]:
        """See `FittedProfile`."""
        span = max(shape[1] - shape[0], self.period_min)
        age = np.maximum(self.time_min - shape[0], 0.0)
        after = np.maximum(age - span, 0.0)
        return ((age - after) / span)[:, None], (0.5 * (age**2 - after**2) / span)[:, None]


class Decay(FittedProfile):
    """First-order approach to the final magnitude."""

    name = "decay"
    shape_names = ("onset", "time_constant")

    def basis_functions(self, shape: Array) -> tuple[Array, Array]:
        """See `FittedProfile`."""
        age = np.maximum(self.time_min - shape[0], 0.0)
        approach = -np.expm1(-age / shape[1])
        return approach[:, None], (age - shape[1] * approach)[:, None]


class Sine(FittedProfile):
    """Sine about zero, from the first row on."""

    name = "sine"
    shape_names: ClassVar[tuple[str, ...]] = ("period",)
    n_linear = 2

    def basis_functions(self, shape: Array) -> tuple[Array, Array]:
        """See `FittedProfile`."""
        rate = 2.0 * pi / shape[0]
        angle = rate * (self.time_min - self.start_min)
        sine, cosine = np.sin(angle), np.cos(angle)
        return np.stack([sine, cosine], axis=1), np.stack([(1.0 - cosine) / rate, sine / rate], axis=1)

    def profile_values(self, parameters: Array) -> dict[str, float]:
        """See `FittedProfile`."""
        size, phase = hypot(parameters[0], parameters[1]), atan2(parameters[1], parameters[0])
        return {"size": size, "onset": self.start_min, "period": float(parameters[2]), "phase": phase}

    def _clip_linear(self, by: Array, lower: float, upper: float) -> Array:
        """Limit the amplitude to the smaller bound; of a one-sided effect, to the other bound."""
        reach = min(-lower, upper) if lower < 0.0 else upper
        return np.asarray(by * min(1.0, reach / max(hypot(*by), 1e-300)))


class LateSine(Sine):
    """Sine about zero that sets in at its onset."""

    shape_names = ("period", "onset")

    def basis_functions(self, shape: Array) -> tuple[Array, Array]:
        """See `FittedProfile`."""
        rate, age = 2.0 * pi / shape[0], np.maximum(self.time_min - shape[1], 0.0)
        on, sine, cosine = self.time_min >= shape[1], np.sin(rate * age), np.cos(rate * age)
        return np.stack([sine, cosine * on], axis=1), np.stack([(1.0 - cosine) / rate, sine / rate], axis=1)

    def profile_values(self, parameters: Array) -> dict[str, float]:
        """See `FittedProfile`."""
        return super().profile_values(parameters) | {"onset": float(parameters[3])}

    def from_sine(self, parameters: Array, onset_min: float) -> Array:
        """Parameters of a sine that is the same from an onset on."""
        angle = 2.0 * pi / parameters[2] * (onset_min - self.start_min)
        turn = np.array([[cos(angle), -sin(angle)], [sin(angle), cos(angle)]])
        return np.concatenate([turn @ parameters[:2], [parameters[2], onset_min], parameters[3:]])


class PiecewiseLinear(FittedProfile):
    """Piecewise-linear curve with equidistant knots.

    Args:
        time_min: times of the rows.
        knots: number of knots.
    """

    name = "free"

    def __init__(self, time_min: Array, knots: int) -> None:
        super().__init__(time_min)
        self.n_linear = knots
        self.knots_min = np.linspace(self.start_min, self.end_min, knots)
        self._value = hat_functions((time_min - self.start_min) / (self.end_min - self.start_min), knots)
        means = 0.5 * (self._value[1:] + self._value[:-1]) * self._step[:, None]
        self._area = np.concatenate([np.zeros((1, knots)), np.cumsum(means, axis=0)])

    def basis_functions(self, shape: Array) -> tuple[Array, Array]:
        """See `FittedProfile`."""
        return self._value, self._area

    def profile_values(self, parameters: Array) -> dict[str, float]:
        """See `FittedProfile`. The size is the largest deviation; the values are fractions of it."""
        values = parameters[: self.n_linear]
        size = float(values[np.argmax(np.abs(values))])
        result = {"size": size}
        result |= {f"time_{index}": float(time_min) for index, time_min in enumerate(self.knots_min, start=1)}
        return result | {f"value_{index}": float(value) / (size or 1.0) for index, value in enumerate(values, start=1)}


def hat_functions(share: Array, count: int) -> Array:
    """Hat functions of equidistant knots: 1 at one knot, 0 at the others.

    Args:
        share: positions from 0 at the first knot to 1 at the last, shape (n,).
        count: number of knots, at least 2.

    Returns:
        Shape (n, count).
    """
    index = share * (count - 1)
    knot = np.minimum(index.astype(np.intp), count - 2)
    rows, result = np.arange(share.size), np.zeros((share.size, count))
    result[rows, knot], result[rows, knot + 1] = 1.0 - (index - knot), index - knot
    return result
