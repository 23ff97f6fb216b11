"""Axes and their ticks. Pure.

Steps are 1, 2 or 5 times a power of ten, as on any instrument.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Axis(NamedTuple):
    """An axis that holds some values.

    Attributes:
        lower: start of the axis.
        upper: end of the axis.
        ticks: shape (ticks,), between both.
        labels: a text for each tick.
    """

    lower: float
    upper: float
    ticks: NDArray[np.float64]
    labels: tuple[str, ...]

    def share(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions of values, 0 at the beginning of the axis and 1 at its end."""
        return (values - self.lower) / (self.upper - self.lower)


def axis(lowest: float, highest: float, intervals: int = 5) -> Axis:
    """The axis for values from the lowest to the highest, with a little room at both ends.

    Args:
        lowest: smallest value.
        highest: largest value.
        intervals: about how many steps it should have.

    Raises:
        ValueError: the values are not finite, or in the wrong order.
    """
    if not -math.inf < lowest <= highest < math.inf:
        raise ValueError(f"an axis must hold finite values, lowest first, got {lowest!r} and {highest!r}")
    if lowest == highest:
        around = abs(highest) * 0.01 or 1.0
        lowest, highest = lowest - around, highest + around
    span = highest - lowest
    lower, upper = lowest - 0.04 * span, highest + 0.04 * span
    power = math.floor(math.log10(span / intervals))
    size, power = min(
        ((digit, power + up) for digit in (1, 2, 5) for up in (0, 1)),
        key=lambda step: abs(math.log(step[0] * 10.0 ** step[1] * intervals / span)),
    )
    step = size * 10.0**power
    counts = np.arange(math.ceil(lower / step), math.floor(upper / step) + 1)
    decimals = max(0, -power)
    ticks = np.round(counts * step, decimals)
    return Axis(lower, upper, ticks, tuple(f"{tick:.{decimals}f}" for tick in ticks))
