"""The course of a deviation in time, m(t): what the profiles of the catalogue are for a fit.

A course is a sum of functions of time whose coefficients enter linearly, and some have numbers that shape these
functions, such as an onset. Between two rows a process feels the mean of m, a sensor shows what m is at the row. So a
deviation is two signals: `over_row`, held from each row to the next one, and `at_row`. An onset between two rows
enters through the mean: the fit follows it continuously.

Times are minutes of the plant. The numbers of a course are written as its profile has them
(`reactorwatch.process.profiles`), so what was fitted can be put into a model, or into the plant.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from math import atan2, hypot, pi
from typing import ClassVar, NamedTuple

import numpy as np

from reactorwatch.arrays import Array


class Signal(NamedTuple):
    """A deviation as signals, or several; shape (rows,) or (rows, n).

    Attributes:
        over_row: mean from each row to the next one; of the last row, as it is then.
        at_row: at each row.
    """

    over_row: Array
    at_row: Array


@dataclass(frozen=True)
class Number:
    """A number that shapes a course.

    Attributes:
        name: as in the profile.
        unit: of its value.
        lower: smallest value.
        upper: largest value.
        difference: the least one for its derivative.
    """

    name: str
    unit: str
    lower: float
    upper: float
    difference: float


class Course(ABC):
    """A kind of course over the rows of one record.

    Args:
        time_min: of the rows, shape (rows,).

    Attributes:
        name: of the profile.
        coefficients: how many functions are summed.
    """

    name: ClassVar[str]
    coefficients: int = 1

    def __init__(self, time_min: Array) -> None:
        self.time_min = time_min
        self.begin_min, self.end_min = float(time_min[0]), float(time_min[-1])
        self.period_min = float(np.median(np.diff(time_min)))
        self._step = np.diff(time_min)

    @property
    def numbers(self) -> tuple[Number, ...]:
        """That shape its functions."""
        return ()

    @property
    def freedom(self) -> int:
        """How many numbers are fitted."""
        return self.coefficients + len(self.numbers)

    @abstractmethod
    def functions(self, shape: Array) -> tuple[Array, Array]:
        """The functions and their integrals from the first row, each of shape (rows, coefficients)."""

    @abstractmethod
    def parameters(self, theta: Array) -> dict[str, float]:
        """The numbers of the profile; `size` first."""

    def unit(self, name: str, unit_of_size: str) -> str:
        """Of a parameter."""
        if name.startswith("value"):
            return "1"
        return {"size": unit_of_size, "phase": "rad"}.get(name, "min")

    def basis(self, shape: Array) -> Signal:
        """The functions as signals, shape (rows, coefficients), without gaps in memory."""
        return self._formed(shape) if self.numbers else self._only

    @cached_property
    def _only(self) -> Signal:
        """Of a course whose functions no number shapes."""
        return self._formed(np.empty(0))

    def _formed(self, shape: Array) -> Signal:
        value, area = self.functions(shape)
        over_row = np.append(np.diff(area, axis=0) / self._step[:, None], value[-1:], axis=0)
        return Signal(over_row, value)

    def signal(self, theta: Array) -> Signal:
        """The deviation; theta has the coefficients first, then the numbers."""
        over_row, at_row = self.basis(theta[self.coefficients :])
        by = theta[: self.coefficients]
        return Signal(over_row @ by, at_row @ by)

    def derivatives(self, theta: Array, differences: Array) -> Signal:
        """Of the deviation by theta, shape (rows, freedom).

        Args:
            theta: coefficients, then numbers.
            differences: of the numbers, from which theirs come; at least those of `numbers`.
        """
        basis = self.basis(theta[self.coefficients :])
        if not self.numbers:
            return basis
        columns = [basis]
        for place, (number, difference) in enumerate(
            zip(self.numbers, differences, strict=True), start=self.coefficients
        ):
            low, high = theta.copy(), theta.copy()
            low[place] = max(theta[place] - difference, min(number.lower, theta[place] - number.difference))
            high[place] = min(theta[place] + difference, max(number.upper, theta[place] + number.difference))
            near = zip(self.signal(low), self.signal(high), strict=True)
            columns.append(Signal(*((after - before)[:, None] / (high[place] - low[place]) for before, after in near)))
        return Signal(*(np.concatenate(items, axis=1) for items in zip(*columns, strict=True)))

    @property
    def least_differences(self) -> Array:
        """Of the numbers, for their derivatives; shape (numbers,)."""
        return np.array([number.difference for number in self.numbers])

    def limited(self, theta: Array, lower: float, upper: float) -> Array:
        """The nearest possible numbers."""
        found = theta.copy()
        found[: self.coefficients] = self._coefficients_limited(theta[: self.coefficients], lower, upper)
        for place, number in enumerate(self.numbers, start=self.coefficients):
            found[place] = min(max(found[place], number.lower), number.upper)
        return found

    def _coefficients_limited(self, by: Array, lower: float, upper: float) -> Array:
        return np.clip(by, lower, upper)

    def _onset(self) -> Number:
        return Number("onset", "min", self.begin_min, self.end_min - self.period_min, self.period_min / 2)


class Constant(Course):
    """There all the time."""

    name = "constant"

    def functions(self, shape: Array) -> tuple[Array, Array]:
        """See `Course`."""
        return np.ones((self.time_min.size, 1)), self.time_min[:, None] - self.begin_min

    def parameters(self, theta: Array) -> dict[str, float]:
        """See `Course`."""
        return {"size": float(theta[0])}


class Step(Course):
    """Sets in at once and stays."""

    name = "step"

    @property
    def numbers(self) -> tuple[Number, ...]:
        """See `Course`."""
        return (self._onset(),)

    def functions(self, shape: Array) -> tuple[Array, Array]:
        """See `Course`."""
        age = self.time_min - shape[0]
        return (age >= 0.0).astype(float)[:, None], np.maximum(age, 0.0)[:, None]

    def parameters(self, theta: Array) -> dict[str, float]:
        """See `Course`."""
        return {"size": float(theta[0]), "onset": float(theta[1])}


class Ramp(Course):
    """Grows evenly from its onset to the end of the record."""

    name = "ramp"

    @property
    def numbers(self) -> tuple[Number, ...]:
        """See `Course`."""
        return (self._onset(),)

    def functions(self, shape: Array) -> tuple[Array, Array]:
        """See `Course`."""
        age, span = np.maximum(self.time_min - shape[0], 0.0), max(self.end_min - shape[0], self.period_min)
        return (age / span)[:, None], (0.5 * age**2 / span)[:, None]

    def parameters(self, theta: Array) -> dict[str, float]:
        """See `Course`."""
        return {"size": float(theta[0]), "onset": float(theta[1]), "end": self.end_min}


class Decay(Course):
    """Approaches its size exponentially."""

    name = "decay"

    @property
    def numbers(self) -> tuple[Number, ...]:
        """See `Course`."""
        shortest, longest = 5.0 * self.period_min, 3.0 * (self.end_min - self.begin_min)
        return (self._onset(), Number("time_constant", "min", shortest, longest, 0.1 * shortest))

    def functions(self, shape: Array) -> tuple[Array, Array]:
        """See `Course`."""
        age = np.maximum(self.time_min - shape[0], 0.0)
        left = -np.expm1(-age / shape[1])
        return left[:, None], (age - shape[1] * left)[:, None]

    def parameters(self, theta: Array) -> dict[str, float]:
        """See `Course`."""
        return {"size": float(theta[0]), "onset": float(theta[1]), "time_constant": float(theta[2])}


class Sine(Course):
    """Swings about zero, from the first row on."""

    name = "sine"
    coefficients = 2

    @property
    def numbers(self) -> tuple[Number, ...]:
        """See `Course`."""
        span = self.end_min - self.begin_min
        return (Number("period", "min", 4.0 * self.period_min, span, 1e-5 * span),)

    def functions(self, shape: Array) -> tuple[Array, Array]:
        """See `Course`."""
        rate = 2.0 * pi / shape[0]
        angle = rate * (self.time_min - self.begin_min)
        sine, cosine = np.sin(angle), np.cos(angle)
        return np.stack([sine, cosine], axis=1), np.stack([(1.0 - cosine) / rate, sine / rate], axis=1)

    def parameters(self, theta: Array) -> dict[str, float]:
        """See `Course`."""
        size, phase = hypot(theta[0], theta[1]), atan2(theta[1], theta[0])
        return {"size": size, "onset": self.begin_min, "period": float(theta[2]), "phase": phase}

    def _coefficients_limited(self, by: Array, lower: float, upper: float) -> Array:
        """A swing goes to both sides; of an effect that has but one, too, as far as that goes."""
        reach = min(-lower, upper) if lower < 0.0 else upper
        return np.asarray(by * min(1.0, reach / max(hypot(*by), 1e-300)))


class Free(Course):
    """A curve: straight between knots at even distances.

    Args:
        time_min: of the rows.
        knots: how many.
    """

    name = "free"

    def __init__(self, time_min: Array, knots: int) -> None:
        super().__init__(time_min)
        self.coefficients = knots
        self.knots_min = np.linspace(self.begin_min, self.end_min, knots)
        self._value = hats((time_min - self.begin_min) / (self.end_min - self.begin_min), knots)
        means = 0.5 * (self._value[1:] + self._value[:-1]) * self._step[:, None]
        self._area = np.concatenate([np.zeros((1, knots)), np.cumsum(means, axis=0)])

    def functions(self, shape: Array) -> tuple[Array, Array]:
        """See `Course`."""
        return self._value, self._area

    def parameters(self, theta: Array) -> dict[str, float]:
        """See `Course`. The size is the largest deviation, and the values are shares of it."""
        values = theta[: self.coefficients]
        size = float(values[np.argmax(np.abs(values))])
        found = {"size": size}
        found |= {f"time_{place}": float(time_min) for place, time_min in enumerate(self.knots_min, start=1)}
        return found | {f"value_{place}": float(value) / (size or 1.0) for place, value in enumerate(values, start=1)}


def hats(share: Array, count: int) -> Array:
    """Functions that are straight between knots at even distances, 1 in one and 0 in the others.

    Args:
        share: where, 0 at the first knot and 1 at the last, within; shape (n,).
        count: of knots, at least 2.

    Returns:
        Shape (n, count).
    """
    place = share * (count - 1)
    knot = np.minimum(place.astype(np.intp), count - 2)
    rows, found = np.arange(share.size), np.zeros((share.size, count))
    found[rows, knot], found[rows, knot + 1] = 1.0 - (place - knot), place - knot
    return found
