"""Ticks of axes."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from reactorwatch.axis import axis

numbers = st.floats(-1e9, 1e9, allow_subnormal=False)


@given(numbers, numbers)
def test_ticks_are_few_even_and_round_and_the_values_lie_within(one: float, other: float) -> None:
    lowest, highest = sorted((one, other))
    assume(highest - lowest > 1e-6 * max(abs(lowest), abs(highest), 1e-6))
    found = axis(lowest, highest)
    assert found.lower < lowest
    assert highest < found.upper
    assert 3 <= found.ticks.size <= 10
    steps = np.diff(found.ticks)
    step = steps.mean()
    assert np.allclose(steps, step, rtol=1e-6)
    assert min(abs(math.log10(step / digit) % 1.0 - whole) for digit in (1, 2, 5) for whole in (0, 1)) < 1e-6
    assert len(set(found.labels)) == found.ticks.size
    assert [float(label) for label in found.labels] == found.ticks.tolist()


def test_an_instruments_axis() -> None:
    found = axis(0.0521, 0.1298)
    assert found.labels == ("0.06", "0.08", "0.10", "0.12")
    assert found.share(np.array([found.lower, found.upper])).tolist() == [0.0, 1.0]


def test_one_value_alone_has_an_axis_too() -> None:
    for value in (0.0, 438.54, -3.0):
        found = axis(value, value)
        assert found.lower < value < found.upper
        assert found.ticks.size > 1


@pytest.mark.parametrize("ends", [(1.0, 0.0), (math.nan, 1.0), (0.0, math.inf)])
def test_an_axis_needs_ends(ends: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match="an axis must hold finite values, lowest first"):
        axis(*ends)
