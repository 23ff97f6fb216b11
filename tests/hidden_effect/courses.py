"""Profile of a hidden deviation, as numbers that the compiled plant of `plant.py` reads.

Written independently from the words of the catalogue (constant, step, ramp, decay, sine, free), so that the software's
profiles are checked and not repeated. Beside them are `pulses`, on and off repeatedly, which are no profile.
"""

from dataclasses import dataclass
from math import exp, floor, pi, sin

import numpy as np
from numpy.typing import NDArray

from reactorwatch.codegen.numba_kernel import jit

Array = NDArray[np.float64]

CONSTANT, STEP, RAMP, DECAY, SINE, FREE, PULSES = range(7)
KINDS = ("constant", "step", "ramp", "decay", "sine", "free", "pulses")


@dataclass(frozen=True, eq=False)
class HiddenCourse:
    """The course m(t) of a deviation.

    Attributes:
        kind: `constant`, `step`, `ramp`, `decay`, `sine`, `free` or `pulses`.
        size: m, once it is all there; of a free curve the largest deviation.
        onset_min: when it sets in; of a sine, where its phase is counted from.
        end_min: of a ramp.
        time_constant_min: of a decay.
        period_min: of a sine or of pulses.
        phase_rad: of a sine.
        knots_min: of a free curve, which is straight between knots; shape (knots,).
        values: there, shape (knots,).
    """

    kind: str
    size: float
    onset_min: float = 0.0
    end_min: float = 0.0
    time_constant_min: float = 1.0
    period_min: float = 1.0
    phase_rad: float = 0.0
    knots_min: Array | None = None
    values: Array | None = None

    @property
    def numbers(self) -> Array:
        """As `value` takes them, shape (8 + 2 knots,)."""
        knots = np.empty(0) if self.knots_min is None else self.knots_min
        values = np.empty(0) if self.values is None else self.values
        head = [
            KINDS.index(self.kind),
            self.size,
            self.onset_min,
            self.end_min,
            self.time_constant_min,
            self.period_min,
            self.phase_rad,
            knots.size,
        ]
        return np.concatenate([np.array(head, dtype=np.float64), knots, values])

    def breaks_min(self, begin_min: float, end_min: float) -> Array:
        """Times at which it jumps or has a kink."""
        if self.kind == "constant":
            return np.empty(0)
        if self.kind == "free":
            assert self.knots_min is not None
            return self.knots_min
        if self.kind == "pulses":
            first = self.onset_min + self.period_min * floor((begin_min - self.onset_min) / self.period_min)
            return np.arange(first, end_min + self.period_min, self.period_min / 2)
        return np.array([self.onset_min, self.end_min] if self.kind == "ramp" else [self.onset_min])

    def at(self, time_min: Array) -> Array:
        """The deviation at some times, shape of these."""
        return values(self.numbers, time_min, time_min)


@jit
def _between(numbers: Array, t: float) -> float:
    """Straight between knots; before the first and after the last as there."""
    knots = int(numbers[7])
    low, high = 0, knots - 1
    if t <= numbers[8]:
        return float(numbers[8 + knots])
    if t >= numbers[8 + high]:
        return float(numbers[8 + knots + high])
    while high - low > 1:
        middle = (low + high) // 2
        if numbers[8 + middle] <= t:
            low = middle
        else:
            high = middle
    share = (t - float(numbers[8 + low])) / float(numbers[8 + high] - numbers[8 + low])
    return float(numbers[8 + knots + low]) * (1.0 - share) + float(numbers[8 + knots + high]) * share


@jit
def value(numbers: Array, t: float, middle: float) -> float:
    """The deviation at a time; `middle`, of the stretch that is gone, decides on which side of a jump that is."""
    kind, size, onset = int(numbers[0]), float(numbers[1]), float(numbers[2])
    if kind == CONSTANT:
        return size
    if kind == FREE:
        return _between(numbers, t)
    if kind == SINE:
        return size * sin(2.0 * pi * (t - onset) / float(numbers[5]) + float(numbers[6]))
    if kind == PULSES:
        turns = (middle - onset) / float(numbers[5])
        return size if turns - floor(turns) < 0.5 else 0.0
    if middle < onset:
        return 0.0
    if kind == STEP:
        return size
    if kind == RAMP:
        end = float(numbers[3])
        return size if middle >= end else size * (t - onset) / (end - onset)
    return size * (1.0 - exp(-(t - onset) / float(numbers[4])))


@jit
def values(numbers: Array, time_min: Array, middle: Array) -> Array:
    """`value` at some times."""
    found = np.empty(time_min.size)
    for place in range(time_min.size):
        found[place] = value(numbers, time_min[place], middle[place])
    return found
