"""Sensors, valve and process noise: of the size asked for, each from a stream of its own."""

from dataclasses import replace
from math import sqrt
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_lyapunov
from scipy.stats import chi2, kstest

from plant_node.config import PlantConfig
from plant_node.instruments import BLOCK, Actuator, ProcessNoise, Sensor
from plant_node.record import plant_from, simulate_record
from reactorwatch.arrays import Array
from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.cstr_operation import LevelControl
from reactorwatch.process.model import ProcessModel, variable
from reactorwatch.process.steady_state import linearise, steady_states
from tests.unit.plant_node.reactor import QUIET

SENSOR_ROWS = 20_000


def noise(signal: str, sd: float, seed: int = 0) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    sensor = Sensor(signal, sd, 0.0, seed)
    return np.array([sensor.reading(0.0, row) for row in range(SENSOR_ROWS)])


@pytest.mark.parametrize(("signal", "sd"), [("C", 0.002), ("T", 0.3)])
def test_noise_has_the_standard_deviation_asked_for(signal: str, sd: float) -> None:
    """(n - 1) s^2 / sd^2 is chi-square: within its 1e-4 quantiles, and the mean within 4 standard errors."""
    found = noise(signal, sd)
    statistic = (SENSOR_ROWS - 1) * np.var(found, ddof=1) / sd**2
    assert chi2.ppf(1e-4, SENSOR_ROWS - 1) < statistic < chi2.isf(1e-4, SENSOR_ROWS - 1)
    assert abs(found.mean()) < 4 * sd / np.sqrt(SENSOR_ROWS)
    assert kstest(found / sd, "norm").pvalue > 1e-3


def test_noise_is_white_also_from_block_to_block() -> None:
    found = noise("T", 1.0)
    for lag in (1, 2, 10, BLOCK):
        assert abs(np.corrcoef(found[lag:], found[:-lag])[0, 1]) < 4 / np.sqrt(SENSOR_ROWS - lag)


def test_noises_of_signals_and_seeds_are_independent() -> None:
    for one, other in ((noise("C", 1.0), noise("T", 1.0)), (noise("T", 1.0, 0), noise("T", 1.0, 1))):
        assert abs(np.corrcoef(one, other)[0, 1]) < 4 / np.sqrt(SENSOR_ROWS)


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


ROWS = 4000


def still() -> ProcessModel:
    """A plant in which nothing happens: what moves is noise."""
    return replace(cstr(), rhs=(ca.SX(0), ca.SX(0)))


def states(name: str, count: int = ROWS, model: ProcessModel | None = None, **settings: Any) -> Array:
    values = {"noise_sd": QUIET, "scenario": "constant", "start": {"C": 1.0, "T": 440.0}, **settings}
    plant = plant_from(PlantConfig(**values), model or still())
    found = []
    for _ in range(count):
        found.append(plant.state[name])
        plant.next_row()
    return np.array(found)


@pytest.mark.parametrize("period_min", [0.1, 0.4])
@pytest.mark.parametrize(("name", "sd"), [("C", 1e-4), ("T", 0.2)])
def test_increments_are_normal_with_variance_sd_squared_times_the_period(
    name: str, sd: float, period_min: float
) -> None:
    """(n - 1) s^2 / sigma^2 is chi-square: within its 1e-4 quantiles; successive ones do not correlate."""
    found = np.diff(states(name, process_noise_sd={name: sd}, period_min=period_min))
    sigma, free = sd * np.sqrt(period_min), found.size - 1
    assert chi2.ppf(1e-4, free) < free * np.var(found, ddof=1) / sigma**2 < chi2.isf(1e-4, free)
    assert kstest(found / sigma, "norm").pvalue > 1e-3
    assert abs(np.corrcoef(found[1:], found[:-1])[0, 1]) < 4 / np.sqrt(found.size)


def test_each_state_and_each_sensor_has_a_stream_of_its_own() -> None:
    both = {"C": 1e-4, "T": 0.2}
    of_T = states("T", process_noise_sd=both)
    np.testing.assert_array_equal(of_T, states("T", process_noise_sd={"T": 0.2}))
    np.testing.assert_array_equal(of_T, states("T", process_noise_sd=both, noise_sd={}))
    assert np.all(np.diff(of_T) != np.diff(states("T", process_noise_sd=both, seed=1)))
    config = PlantConfig(noise_sd={"T": 1.0}, scenario="constant", start={"C": 1.0, "T": 440.0})
    of_sensor = simulate_record(config, ROWS, still()).columns["T"] - 440.0
    for one, other in ((np.diff(of_T), of_sensor[1:]), (np.diff(of_T), np.diff(states("C", process_noise_sd=both)))):
        for lag in (0, 1):
            assert abs(np.corrcoef(one[lag:], other[: other.size - lag])[0, 1]) < 4 / np.sqrt(ROWS)


def test_none_is_what_the_plant_was_without_it_bit_for_bit() -> None:
    one, other = (simulate_record(PlantConfig(seed=3, process_noise_sd=sd), 200) for sd in ({}, {"T": 0.0}))
    for signal in ("qc", "C", "T"):
        np.testing.assert_array_equal(one.columns[signal], other.columns[signal])


def test_the_first_row_is_the_start_and_the_rows_do_not_depend_on_how_many_there_are() -> None:
    config = PlantConfig(seed=3, process_noise_sd={"C": 1e-3, "T": 0.3}, start={"C": 0.1, "T": 438.54}, noise_sd=QUIET)
    long, short = simulate_record(config, 200), simulate_record(config, 50)
    assert (long.columns["C"][0], long.columns["T"][0]) == (0.1, 438.54)
    np.testing.assert_array_equal(long.columns["T"][:50], short.columns["T"])


def test_the_plant_propagates_it_as_its_linear_model_does() -> None:
    """The stationary covariance P = Phi P Phi' + Q of the sampled linear model, here for small noise."""
    sd, qc, period_min = np.array([1e-5, 0.02]), np.array([95.0]), 0.1
    point = steady_states(cstr(), qc)[-1]
    phi = expm(linearise(cstr(), point.state, qc).A * period_min)
    expected = np.sqrt(np.diag(solve_discrete_lyapunov(phi, np.diag(sd**2 * period_min))))
    settings: dict[str, Any] = {
        "process_noise_sd": dict(zip("CT", sd.tolist(), strict=True)),
        "scenario": {"kind": "constant", "level_l_min": 95.0},
        "start": "operating",
    }
    for name, size in zip("CT", expected, strict=True):
        # 400 min are some 1000 correlation times: the standard error is a few per cent.
        assert np.std(states(name, model=cstr(), **settings)) == pytest.approx(size, rel=0.1)


def test_a_concentration_does_not_go_below_nothing() -> None:
    found = states("C", 1000, process_noise_sd={"C": 0.5}, start={"C": 0.1, "T": 440.0})
    assert found.min() == 0.0
    assert np.mean(found == 0.0) < 0.5
    assert found.max() <= 2.0


@pytest.mark.parametrize(("value", "farthest"), [(710.0, max), (240.0, min)])
def test_a_state_that_is_out_of_its_bounds_by_itself_is_not_pulled_back(value: float, farthest: Any) -> None:
    noise = ProcessNoise(variable("T", "K", (250.0, 700.0), 1.0, "temperature"), sqrt(0.1), seed=0)
    moved = [noise.add_to(value, row) for row in range(200)]
    assert farthest(moved) == value
    assert 0.0 < abs(np.mean(moved) - value) < 1.0


def test_while_the_state_is_held_it_is_held() -> None:
    never_a_number = ca.sqrt(ca.SX(-1))
    model = replace(cstr(), rhs=(ca.SX(0), never_a_number))
    found = states("T", 10, model=model, process_noise_sd={"T": 0.2}, start={"C": 0.1, "T": 600.0})
    assert set(found) == {600.0}


def test_the_level_may_be_noisy_too_and_a_fault_leaves_the_streams_alone() -> None:
    settings: dict[str, Any] = {"level_control": LevelControl(), "process_noise_sd": {"V": 0.5}, "start": "operating"}
    found = states("V", 2000, model=cstr(), **settings)
    # An AR(1) with the factor exp(-Kc h) and innovations of variance sd^2 h.
    assert np.std(found) == pytest.approx(0.5 * np.sqrt(0.1 / (1 - np.exp(-2 * 5.0 * 0.1))), rel=0.1)
    faulty = states("V", 2000, model=cstr(), faults=("temperature_bias:step:2@10min",), **settings)
    np.testing.assert_array_equal(found, faulty)


def test_a_state_that_there_is_not_is_refused() -> None:
    with pytest.raises(InputError) as caught:
        plant_from(PlantConfig(process_noise_sd={"V": 0.1}))
    assert str(caught.value) == "process_noise_sd: cstr has no state 'V' (valid: C, T)"
