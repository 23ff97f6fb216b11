"""The newest rows of a quiet plant take less room than their numbers, and lose no bit."""

import numpy as np
import pytest

from monitor_node.quiet.ring import kept_values, reference_bits, values_of

TYPICAL = np.array([100.0, 0.1, 440.0])


def test_values_come_back_to_the_last_bit() -> None:
    generator = np.random.default_rng(1)
    values = TYPICAL * 10.0 ** generator.uniform(-2, 2, (10_000, 3))
    values[-1] = TYPICAL
    reference = reference_bits(values)
    kept = kept_values(values, reference)
    assert kept is not None
    assert kept.shape == (10_000, 21)
    assert values_of(kept, reference).tobytes() == values.tobytes()


def test_zero_comes_back_whatever_else_a_signal_is() -> None:
    values = np.array([[0.0, 0.1, 0.0], [100.0, 0.0, 0.0]])
    reference = reference_bits(values)
    kept = kept_values(values, reference)
    assert kept is not None
    assert values_of(kept, reference).tobytes() == values.tobytes()


@pytest.mark.parametrize("other", [-100.0, 1e-3, 1e5, -0.0, 5e-324])
def test_values_of_another_sign_or_size_do_not_fit(other: float) -> None:
    values = np.array([[other], [100.0]])
    assert kept_values(values, reference_bits(values)) is None


def test_rows_without_values_are_kept() -> None:
    values = np.empty((5, 0))
    kept = kept_values(values, reference_bits(values))
    assert kept is not None
    assert values_of(kept, reference_bits(values)).shape == (5, 0)
