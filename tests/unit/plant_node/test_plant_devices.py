"""Sensors and the valve."""

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from plant_node.instruments import BLOCK, Actuator, Sensor

ROWS = 20_000


def noise(signal: str, sd: float, seed: int = 0) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    sensor = Sensor(signal, sd, 0.0, seed)
    return np.array([sensor.reading(0.0, row) for row in range(ROWS)])


@pytest.mark.parametrize(("signal", "sd"), [("C", 0.002), ("T", 0.3)])
def test_noise_has_the_standard_deviation_asked_for(signal: str, sd: float) -> None:
    """(n - 1) s^2 / sd^2 is chi-square: within its 1e-4 quantiles, and the mean within 4 standard errors."""
    found = noise(signal, sd)
    statistic = (ROWS - 1) * np.var(found, ddof=1) / sd**2
    assert chi2.ppf(1e-4, ROWS - 1) < statistic < chi2.isf(1e-4, ROWS - 1)
    assert abs(found.mean()) < 4 * sd / np.sqrt(ROWS)
    assert kstest(found / sd, "norm").pvalue > 1e-3


def test_noise_is_white_also_from_block_to_block() -> None:
    found = noise("T", 1.0)
    for lag in (1, 2, 10, BLOCK):
        assert abs(np.corrcoef(found[lag:], found[:-lag])[0, 1]) < 4 / np.sqrt(ROWS - lag)


def test_noises_of_signals_and_seeds_are_independent() -> None:
    for one, other in ((noise("C", 1.0), noise("T", 1.0)), (noise("T", 1.0, 0), noise("T", 1.0, 1))):
        assert abs(np.corrcoef(one, other)[0, 1]) < 4 / np.sqrt(ROWS)


def test_reading_depends_on_the_row_alone() -> None:
    sensor = Sensor("T", 0.3, 0.0, 5)
    forwards = [sensor.reading(440.0, row) for row in range(3 * BLOCK)]
    assert [sensor.reading(440.0, row) for row in reversed(range(3 * BLOCK))] == forwards[::-1]


def test_without_noise_it_shows_what_is_there() -> None:
    assert Sensor("T", 0.0, 0.0, 0).reading(441.234567, 7) == 441.234567


def test_resolution_rounds_to_its_nearest_multiple() -> None:
    sensor = Sensor("T", 0.0, 0.25, 0)
    assert [sensor.reading(value, 0) for value in (440.1, 440.13, 440.3, -0.2)] == [440.0, 440.25, 440.25, -0.25]


def test_valve_lets_through_no_more_and_no_less_than_it_can() -> None:
    valve = Actuator(10.0, 200.0)
    assert [valve.limit(command) for command in (-5.0, 10.0, 103.4, 1e9)] == [10.0, 10.0, 103.4, 200.0]
    assert [valve.reaches(command) for command in (9.9, 10.0, 200.0, 200.1)] == [False, True, True, False]
