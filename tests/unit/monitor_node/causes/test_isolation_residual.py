"""A residual of the best cause is detected, and errors of the trained noise are not taken for one."""

import numpy as np
import pytest

from monitor_node.causes.isolation import log_evidence_of_residual
from reactorwatch.arrays import Array

ROWS = 1300


def noise(seed: int) -> Array:
    return np.asarray(np.random.default_rng(seed).standard_normal((ROWS, 2)))


def evidence(w: Array) -> float:
    return log_evidence_of_residual(w, np.ones(w.shape, dtype=bool))


@pytest.mark.parametrize("scale", [0.94, 1.0, 1.06])
def test_white_noise_is_no_residual_even_if_the_training_found_its_variance_a_tenth_too_small(scale: float) -> None:
    assert max(evidence(scale * noise(seed)) for seed in range(5)) < 1.0


def test_a_slow_deviation_a_third_as_large_as_the_noise_is_a_residual() -> None:
    slow = 0.35 * np.sin(np.arange(ROWS) / 30.0)[:, None]
    assert evidence(noise(1) + slow) > 5.0


def test_noise_half_as_large_again_is_a_residual() -> None:
    assert evidence(1.5 * noise(1)) > 5.0


def test_without_measurements_there_is_no_residual() -> None:
    w = np.zeros((ROWS, 2))
    assert log_evidence_of_residual(w, np.zeros(w.shape, dtype=bool)) <= 0.0
    assert log_evidence_of_residual(w[:0], np.zeros((0, 2), dtype=bool)) <= 0.0
