"""The newest rows of a quiet plant take less room than their numbers, and lose no bit."""

import numpy as np
import pytest

from monitor_node.fleet.packed.record import LEVELS
from monitor_node.fleet.packed.ring import kept_values, values_of

TYPICAL = np.array([100.0, 0.1, 440.0])


@pytest.mark.parametrize(("inputs", "row_bytes"), [(1, 15), (2, 9)])
def test_values_come_back_to_the_last_bit(inputs: int, row_bytes: int) -> None:
    generator = np.random.default_rng(1)
    values = TYPICAL * 10.0 ** generator.uniform(-2, 2, (10_000, 3))
    values[-1] = TYPICAL
    kept = kept_values(values, inputs)
    assert kept is not None
    assert kept.rows.shape == (10_000, row_bytes)
    assert values_of(kept).tobytes() == values.tobytes()


def test_zero_comes_back_whatever_else_a_signal_is() -> None:
    values = np.array([[0.0, 0.1, 0.0], [100.0, 0.0, 0.0]])
    kept = kept_values(values, 1)
    assert kept is not None
    assert values_of(kept).tobytes() == values.tobytes()


@pytest.mark.parametrize("other", [-100.0, 1e-3, 1e5, -0.0, 5e-324])
def test_measured_values_of_another_sign_or_size_do_not_fit(other: float) -> None:
    assert kept_values(np.array([[1.0, other], [1.0, 100.0]]), 1) is None


@pytest.mark.parametrize("other", [-100.0, 1e-3, 1e5, -0.0, 5e-324])
def test_an_input_may_be_any_number(other: float) -> None:
    values = np.array([[other, 1.0], [100.0, 1.0]])
    kept = kept_values(values, 1)
    assert kept is not None
    assert values_of(kept).tobytes() == values.tobytes()


def test_an_input_that_is_held_takes_a_byte_a_row_and_nothing_else() -> None:
    inputs = np.repeat(np.random.default_rng(2).uniform(80, 120, LEVELS), 10)
    kept = kept_values(np.column_stack([inputs, inputs[::-1], inputs]), 2)
    assert kept is not None
    assert kept.rows.shape == (10 * LEVELS, 9)
    assert not kept.others.any()
    assert kept.level_rows.tolist() == [[10] * LEVELS] * 2


def test_rows_without_values_are_kept() -> None:
    kept = kept_values(np.empty((5, 0)), 1)
    assert kept is not None
    assert values_of(kept).shape == (5, 0)
