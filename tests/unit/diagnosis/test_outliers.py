"""Values that are off for a moment are left out; what a plant does, and the steps of a coarse sensor, are not."""

import numpy as np
import pytest
from numpy.typing import NDArray

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.outliers import find_gross_outliers, find_outliers, remove_outliers
from reactorwatch.diagnosis.run import Run

ROWS = 5000


def noise(seed: int = 1, sd: float = 0.3) -> Array:
    return np.random.default_rng(seed).standard_normal((ROWS, 2)) * sd


def spiked(values: Array, share: float, sds: float, sd: float = 0.3, seed: int = 2) -> tuple[Array, NDArray[np.bool_]]:
    random = np.random.default_rng(seed)
    off: NDArray[np.bool_] = random.random(values.shape) < share
    return values + off * random.choice([-1.0, 1.0], values.shape) * sds * sd, off


@pytest.mark.parametrize(("share", "sds", "caught"), [(0.01, 12.0, 0.95), (0.05, 12.0, 0.85), (0.001, 1e6, 0.99)])
def test_outliers_are_found_and_nothing_else_is(share: float, sds: float, caught: float) -> None:
    values, off = spiked(noise(), share, sds)
    found = find_outliers(values, values)
    assert np.mean(found[off]) > caught
    assert np.count_nonzero(found & ~off) <= 2  # of ten thousand


def test_a_gross_one_is_detected_without_a_model_in_the_first_row_too() -> None:
    moving = noise(sd=0.05) + 5.0 * np.abs(np.sin(0.3 * np.arange(ROWS)))[:, None]  # with a sharp turn in ten rows
    assert not np.any(find_gross_outliers(moving))
    for row in (0, 700, ROWS - 1):
        spoiled = moving.copy()
        spoiled[row, 1] += 300.0
        assert np.argwhere(find_gross_outliers(spoiled)).tolist() == [[row, 1]]


@pytest.mark.parametrize(
    "profile",
    [
        lambda k: 30.0 * (k > 2000),  # a jump
        lambda k: 3.0 * np.exp(-(k % 10) / 8.0),  # what a late input leaves after each of its steps
        lambda k: 3.0 * np.abs((k % 20) - 10.0) / 10.0,  # peaks
        lambda k: 5.0 * ((k > 1000) & (k < 1004)),  # four rows are no moment
    ],
)
def test_what_lasts_is_no_outlier(profile: object) -> None:
    assert callable(profile)
    residual = noise(sd=0.05) + np.asarray(profile(np.arange(float(ROWS))))[:, None]
    assert np.count_nonzero(find_outliers(residual, residual)) <= 1


def test_where_the_simulation_alone_has_a_peak_nothing_measured_is_an_outlier() -> None:
    measured = noise() + 40.0 * (1.0 + np.tanh(np.arange(ROWS) - 2500.0))[:, None]  # the reactor ignites
    residual = measured - 40.0 * np.exp(-np.abs(np.arange(ROWS) - 2490.0) / 0.5)[:, None]
    assert not np.any(find_outliers(measured, residual))


@pytest.mark.parametrize("step", [0.15, 0.6, 3.0])
def test_the_steps_of_a_coarse_sensor_are_no_outliers(step: float) -> None:
    coarse = np.round((noise() + np.linspace(0.0, 3.0, ROWS)[:, None]) / step) * step
    assert not np.any(find_outliers(coarse, coarse))
    assert not np.any(find_gross_outliers(coarse))


def test_missing_values_neither_count_nor_hide_an_outlier() -> None:
    values = noise()
    values[np.random.default_rng(3).random(values.shape) < 0.3] = np.nan
    values[99:106, 0] = [0.1, 0.2, np.nan, 8.0, np.nan, -0.1, 0.0]
    assert np.argwhere(find_outliers(values, values)).tolist() == [[102, 0]]


def test_left_out_is_as_missing_and_a_run_without_outliers_stays_itself() -> None:
    run = Run(np.arange(3.0), np.zeros((3, 1)), np.arange(6.0).reshape(3, 2), (1,))
    assert remove_outliers(run, np.zeros((3, 2), dtype=bool)) is run
    found = remove_outliers(run, np.array([[False, False], [False, True], [False, False]]))
    np.testing.assert_array_equal(found.measured, [[0.0, 1.0], [2.0, np.nan], [4.0, 5.0]])
    assert (found.values, found.breaks) == (5, (1,))
    begun = remove_outliers(run, np.array([[False, True], [False, False], [False, False]]))
    np.testing.assert_array_equal(begun.measured, [[np.nan, np.nan], [2.0, 3.0], [4.0, 5.0]])
