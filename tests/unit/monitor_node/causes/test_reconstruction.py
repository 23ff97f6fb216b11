"""Reconstruction of the value that a faulty sensor should read."""

from math import isnan, nan

import numpy as np
import pytest
from scipy.stats import chi2

from monitor_node.causes.stage import Reconstruction, ReconstructionMemory
from monitor_node.causes.window import Row
from reactorwatch.arrays import Array
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process.library.cstr import cstr
from tests.unit.monitor_node.faulty import ONSET_MIN, SENSORS, rows_of

QUIET = {"C": 0.0, "T": 0.0}
NOISY = {"C": 0.002, "T": 0.5}


def reconstruction_of(noise: NoiseLevels, place: int) -> Reconstruction:
    return Reconstruction(cstr(), noise, ReconstructionMemory(cstr().output_names[place], "", [nan]))


def truth_of(seed: int, place: int, process_sd: dict[str, float]) -> Array:
    """What the sensor would read without fault and noise, since the onset: the plant itself is the same."""
    rows = rows_of(seed=seed, after_min=60.0, process_noise_sd=process_sd, noise_sd=QUIET, begin_min=ONSET_MIN)
    return np.array([row[2][place] for row in rows])


def reconstructed(
    fault: str, place: int, noise: NoiseLevels, seed: int, **settings: object
) -> tuple[Array, Array, Array]:
    """What is measured since the onset, what is reconstructed, and its standard deviation."""
    rows = rows_of(fault, seed=seed, after_min=60.0, begin_min=20.0, **settings)
    before = [row for row in rows if row[0] < ONSET_MIN]
    since = [row for row in rows if row[0] >= ONSET_MIN]
    reconstruction = reconstruction_of(noise, place)
    reconstruction.start(before, ONSET_MIN)
    found = np.array([reconstruction.update(*row) for row in since])
    return np.array([row[2][place] for row in since]), found[:, 0], found[:, 1]


@pytest.mark.parametrize(
    ("fault", "place", "allowed"),
    [
        ("temperature_bias:step:3", 1, 0.05),
        ("concentration_bias:step:0.02", 0, 2e-4),
        ("concentration_gain:step:0.4", 0, 2e-4),
    ],
)
def test_of_a_plant_that_the_model_describes_it_is_exact(fault: str, place: int, allowed: float) -> None:
    measured, value, _ = reconstructed(fault, place, SENSORS, 1)
    truth = truth_of(1, place, {})
    assert np.max(np.abs(value - truth)) < allowed
    assert np.sqrt(np.mean((measured - truth) ** 2)) > 50 * allowed


@pytest.mark.parametrize(
    ("fault", "place", "size"), [("temperature_bias:step:3", 1, 3.0), ("concentration_bias:step:0.02", 0, 0.02)]
)
def test_of_a_noisy_process_its_error_matches_its_standard_deviation(fault: str, place: int, size: float) -> None:
    """Errors last for a minute: 600 rows are worth some 60, and within the 1e-4 quantiles of chi-square of as many."""
    noise = NoiseLevels((0.002, 0.3), (NOISY["C"], NOISY["T"]))
    measured, value, sd = reconstructed(fault, place, noise, 2, process_noise_sd=NOISY)
    truth = truth_of(2, place, NOISY)
    ratio = np.mean(((value - truth) / sd) ** 2)
    assert chi2.ppf(1e-4, 60) / 60 < ratio < chi2.isf(1e-4, 60) / 60
    assert np.sqrt(np.mean((value - truth) ** 2)) < 0.25 * np.sqrt(np.mean((measured - truth) ** 2))


def test_a_drift_does_not_pull_it() -> None:
    end_min = ONSET_MIN + 60.0
    truth = truth_of(3, 1, {})
    _, drifting, _ = reconstructed(f"temperature_bias:ramp:20@{ONSET_MIN}min,end={end_min}min", 1, SENSORS, 3)
    assert np.max(np.abs(drifting - truth)) < 0.05


def test_it_leaves_the_sensor_out_some_time_before_the_onset_that_was_found() -> None:
    """An onset is found to within a fraction of a minute: what the sensor read just before it may be wrong already."""
    rows = rows_of(seed=4, after_min=0.0, begin_min=20.0)
    late = [row for row in rows if row[0] > ONSET_MIN - 0.8]
    early = rows[: -len(late)]
    wrong: list[Row] = [(t, flow, (C, T + 50.0)) for t, flow, (C, T) in late]
    one, other = reconstruction_of(SENSORS, 1), reconstruction_of(SENSORS, 1)
    one.start(early + late, ONSET_MIN)
    other.start(early + wrong, ONSET_MIN)
    row = (ONSET_MIN, (100.0,), (0.1, 440.0))
    assert one.update(*row) == other.update(*row)


def test_a_missing_input_keeps_its_value_and_without_any_nothing_is_reconstructed() -> None:
    reconstruction = reconstruction_of(SENSORS, 1)
    assert all(isnan(item) for item in reconstruction.update(0.0, (nan,), (0.1, 440.0)))
    assert all(isnan(item) for item in reconstruction.update(0.1, (100.0,), (0.1, 440.0)))
    known, held = reconstruction.update(0.2, (nan,), (0.1, 440.0)), nan
    other = reconstruction_of(SENSORS, 1)
    for time_min in (0.1, 0.2):
        held = other.update(time_min, (100.0,), (0.1, 440.0))[0]
    assert known[0] == pytest.approx(held, rel=1e-12)
