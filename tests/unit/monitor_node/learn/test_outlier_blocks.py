"""A training that was itself disturbed is trimmed, or refused."""

import numpy as np
import pytest
from scipy.signal import lfilter

from monitor_node.learn.training_rows import screen_baseline


def noise(seed: int, phi: float = 0.0, rows: int = 1000) -> np.ndarray:
    white = np.random.default_rng(seed).normal(size=rows + 300)
    return np.asarray(lfilter([1.0], [1.0, -phi], white))[300:]


@pytest.mark.parametrize(("phi", "most"), [(0.0, 2), (0.5, 4), (0.9, 10)])
def test_an_undisturbed_training_is_hardly_ever_trimmed(phi: float, most: int) -> None:
    assert sum(bool(screen_baseline(noise(seed, phi)).disturbed_intervals) for seed in range(200)) <= most


@pytest.mark.parametrize("start", [0, 320, 800])
def test_a_shifted_stretch_is_left_out_whole_and_little_else(start: int) -> None:
    z = noise(1)
    z[start : start + 200] += 3.0
    found = screen_baseline(z)
    assert not found.refused
    assert not found.usable[start : start + 200].any()
    assert np.count_nonzero(~found.usable) <= 200 + 2 * 40 + found.outliers
    assert found.shifts[0] == pytest.approx(3.0, abs=0.5)


def test_a_stretch_that_is_only_wilder_is_left_out() -> None:
    z = noise(2)
    z[400:560] *= 4.0
    assert np.mean(~screen_baseline(z).usable[400:560]) > 0.9


def test_a_training_disturbed_by_two_fifths_is_refused() -> None:
    z = noise(3)
    z[600:] += 2.5
    assert screen_baseline(z).refused


def test_single_outliers_are_left_out_and_their_block_is_not() -> None:
    z = noise(4)
    z[[50, 333, 700]] += (15.0, -20.0, 30.0)
    found = screen_baseline(z)
    assert (found.outliers, found.disturbed_intervals) == (3, [])
    assert np.flatnonzero(~found.usable).tolist() == [50, 333, 700]


def test_what_is_not_known_is_not_usable_and_disturbs_nothing() -> None:
    z = noise(5)
    z[::7] = np.nan
    found = screen_baseline(z)
    assert found.usable.tolist() == np.isfinite(z).tolist()
    assert not screen_baseline(np.full(10, np.nan)).usable.any()


def test_a_constant_residual_is_usable() -> None:
    assert screen_baseline(np.full(500, 2.0)).usable.all()
