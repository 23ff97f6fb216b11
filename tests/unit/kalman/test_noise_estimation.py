"""Tuning finds the noise that the plant was given, and nothing else."""

import numpy as np
import pytest

from reactorwatch.arrays import Array
from reactorwatch.kalman.batch import FilterRecord
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.kalman.noise_estimation import fit_noise, is_coarse
from reactorwatch.process.library.cstr import cstr
from tests.unit.kalman.plant import record_of

SMALLEST = (2e-4, 0.05)
ROWS = 1000
SD_ERROR = 4 / np.sqrt(2 * ROWS)
"""Four standard errors of a standard deviation from so many normal values, relative."""


def estimate(time_min: Array, inputs: Array, measured: Array) -> NoiseLevels:
    return fit_noise(cstr(), FilterRecord(time_min, inputs, measured), SMALLEST).levels


@pytest.mark.parametrize("noise_sd", [{}, {"C": 0.005, "T": 1.0}])
def test_of_a_plant_that_the_model_describes_it_finds_the_sensors_noise_and_no_other(
    noise_sd: dict[str, float],
) -> None:
    found = estimate(*record_of(ROWS, seed=1, noise_sd=noise_sd))
    np.testing.assert_allclose(found.measurement_sd, (noise_sd.get("C", 0.002), noise_sd.get("T", 0.3)), rtol=SD_ERROR)
    assert found.process_sd == (0.0, 0.0)


def test_it_finds_the_noise_of_the_process_too() -> None:
    """Eight runs scattered by 13 % and 7 % about the truth: three times that is allowed."""
    found = estimate(*record_of(ROWS, seed=2, process_noise_sd={"C": 0.002, "T": 0.5}))
    np.testing.assert_allclose(found.measurement_sd, (0.002, 0.3), rtol=1.3 * SD_ERROR)
    assert found.process_sd[0] == pytest.approx(0.002, rel=0.39)
    assert found.process_sd[1] == pytest.approx(0.5, rel=0.21)


@pytest.mark.parametrize(("state", "sd"), [(0, 0.005), (1, 2.0)])
def test_it_finds_which_state_is_disturbed(state: int, sd: float) -> None:
    found = estimate(*record_of(ROWS, seed=3, process_noise_sd={"CT"[state]: sd}))
    assert found.process_sd[state] == pytest.approx(sd, rel=0.15)
    assert found.process_sd[1 - state] == 0.0


def test_rows_that_are_far_apart_do_not_mislead_it() -> None:
    """The plant moves by some 5 K from row to row, which is not noise."""
    found = estimate(*record_of(ROWS, seed=4, period_min=1.0))
    np.testing.assert_allclose(found.measurement_sd, (0.002, 0.3), rtol=SD_ERROR)
    assert found.process_sd == (0.0, 0.0)


def test_of_a_record_without_noise_it_returns_the_smallest_levels() -> None:
    found = estimate(*record_of(ROWS, seed=5, noise_sd={"C": 0.0, "T": 0.0}))
    assert found.measurement_sd == pytest.approx(SMALLEST, rel=1e-9)
    assert found.process_sd == (0.0, 0.0)


@pytest.mark.parametrize("process_sd", [{}, {"C": 0.002, "T": 0.5}])
def test_spikes_in_two_rows_of_a_hundred_change_it_by_less_than_a_tenth(process_sd: dict[str, float]) -> None:
    time_min, inputs, measured = record_of(ROWS, seed=6, process_noise_sd=process_sd)
    rng = np.random.default_rng(6)
    spiked = measured.copy()
    for column, size in enumerate((0.05, 8.0)):
        spiked[rng.random(ROWS) < 0.02, column] += size
    clean, found = estimate(time_min, inputs, measured), estimate(time_min, inputs, spiked)
    np.testing.assert_allclose(found.measurement_sd, clean.measurement_sd, rtol=0.1)
    np.testing.assert_allclose(found.process_sd, clean.process_sd, rtol=0.1)


def test_what_is_missing_is_not_missed() -> None:
    time_min, inputs, measured = record_of(ROWS, seed=7)
    measured[np.random.default_rng(7).random(measured.shape) < 0.2] = np.nan
    measured[300:330] = np.nan
    found = estimate(time_min, inputs, measured)
    np.testing.assert_allclose(found.measurement_sd, (0.002, 0.3), rtol=1.2 * SD_ERROR)
    assert found.process_sd == (0.0, 0.0)


@pytest.mark.parametrize("smallest", [(0.0, 0.0), (0.0, 0.05), (1e-300, 1e-300)])
@pytest.mark.parametrize("noise_sd", [{"C": 0.0, "T": 0.0}, {"C": 0.0, "T": 0.3}, {"C": 0.002, "T": 0.0}])
def test_a_sensor_without_noise_needs_no_smallest_level(
    smallest: tuple[float, float], noise_sd: dict[str, float]
) -> None:
    found = fit_noise(cstr(), FilterRecord(*record_of(400, seed=5, noise_sd=noise_sd)), smallest).levels
    for sd, least, true in zip(
        found.measurement_sd, smallest, (noise_sd.get("C", 0.002), noise_sd.get("T", 0.3)), strict=True
    ):
        if true > 0.0:
            assert sd == pytest.approx(true, rel=4 / np.sqrt(2 * 400))
        else:
            assert max(0.99 * least, 1e-10) <= sd <= max(1.01 * least, 1e-6)
    assert found.process_sd == (0.0, 0.0)


def test_an_output_that_is_never_measured_has_the_smallest_level_and_one_that_is_always_zero_has_one() -> None:
    time_min, inputs, measured = record_of(ROWS, seed=8)
    measured[:, 0] = np.nan
    found = estimate(time_min, inputs, measured)
    assert found.measurement_sd[0] == pytest.approx(SMALLEST[0], rel=1e-9)
    assert found.measurement_sd[1] == pytest.approx(0.3, rel=SD_ERROR)
    measured[:, 0] = 0.0
    levels = fit_noise(cstr(), FilterRecord(time_min, inputs, measured), (0.0, 0.0)).levels
    assert np.all(np.isfinite([*levels.measurement_sd, *levels.process_sd]))


@pytest.mark.parametrize(("noise", "expected"), [(0.1, True), (0.2, True), (0.6, False), (2.0, False)])
def test_rounding_errors_have_memory_where_the_noise_is_less_than_half_a_step(noise: float, expected: bool) -> None:
    """By simulation: the errors in rows next to each other are correlated, or are not."""
    rng = np.random.default_rng(9)
    exact = 3.0 * np.sin(np.arange(20_000.0) / 200.0) + noise * rng.standard_normal(20_000)
    shown = np.round(exact)
    error = shown - exact
    correlation = float(np.mean(error[1:] * error[:-1]) / np.mean(error**2))
    assert (correlation > 0.05) == expected
    assert is_coarse(shown) == expected
    assert not is_coarse(exact)
