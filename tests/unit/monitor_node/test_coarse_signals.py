"""Quantised signals: none is taken for outliers, and one that cannot be monitored does not affect the others.

A plant whose sensors have no noise is monitored, though no smallest level was stated.
"""

import numpy as np
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.learn.training_rows import screen_baseline
from monitor_node.replay.backtest import run
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract.codec import encode
from reactorwatch.kalman.noise_estimation import resolution
from recorder.tools.player import samples_of

from .samples import Rows
from .test_many_outputs import config_of, plant, raised, watch
from .watching import sound_run, watched

TRAINING, ROWS = 300, 600
NOISE = 0.3


def coarse(values: Rows, step: float) -> Rows:
    """The values with the first output in steps."""
    values = values.copy()
    values[1] = np.round(values[1] / step) * step
    return values


@pytest.mark.parametrize("step", [0.02, 0.1, 0.33, 0.5, 0.8, 1.2, 2.0])
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_an_output_in_steps_is_watched_with_the_others(step: float, seed: int) -> None:
    """Steps of a fifteenth to seven times its noise: no false alarm, and a change of two steps is seen."""
    values = coarse(plant(3, ROWS, seed), step)
    sound = Monitor(config_of(3, TRAINING), 0, points=False)
    assert raised(watch(sound, values)) == []
    assert sound.excluded_signals == {}
    assert sound.memory.watching_since_ns is not None
    assert sound.memory.watching_since_ns / 6e9 == TRAINING
    assert not any("outliers" in note or "anew" in note for note in sound.notes)
    values[1, 500:] += 2 * step * np.ceil(6 * NOISE / (2 * step))
    faulty = Monitor(config_of(3, TRAINING), 0, points=False)
    assert any(name.endswith("/y0") for name in raised(watch(faulty, values)))


@pytest.mark.parametrize("step", [0.33, 1.0, 3.0])
@pytest.mark.parametrize("reference", ["process", "arx"])
def test_a_coarse_thermometer_of_the_reactor_costs_no_training(step: float, reference: str) -> None:
    time_min, columns = sound_run(150.0, seed=2)
    columns["T"] = np.round(columns["T"] / step) * step
    config = MonitorConfig(isolation=False, reference=reference)  # type: ignore[arg-type]
    run = watched(time_min, columns, config)
    assert run.monitor.memory.watching_since_ns == 100 * 60 * 10**9
    assert run.monitor.excluded_signals == {}


@pytest.mark.parametrize("moves", [1, 3, 10])
def test_an_output_that_moves_a_step_now_and_then_is_watched_as_it_is(moves: int) -> None:
    values = plant(3, ROWS)
    values[1] = 20.0
    for row in np.linspace(20, TRAINING - 20, moves).astype(int).tolist():
        values[1, row : row + 7] = 20.33
    monitor = Monitor(config_of(3, TRAINING), 0, points=False)
    assert raised(watch(monitor, values)) == []
    assert monitor.excluded_signals == {}


@pytest.mark.parametrize("held", [2, 5])
def test_an_analyser_that_holds_its_value_for_some_rows_has_no_outliers(held: int) -> None:
    values = plant(3, ROWS)
    values[1] = np.repeat(values[1, ::held], held)[:ROWS]
    monitor = Monitor(config_of(3, TRAINING), 0, points=False)
    watch(monitor, values)
    assert monitor.phase == "watching"
    assert not any("outliers of y0" in note for note in monitor.notes)


def test_an_output_that_never_moves_is_left_out_with_the_reason_and_the_others_are_watched() -> None:
    values = plant(3, ROWS)
    values[1] = 4.25
    monitor = Monitor(config_of(3, TRAINING), 0, points=False)
    values[2, 500:] += 3.0
    values[1, 550:] += 3.0
    names = raised(watch(monitor, values))
    why = (
        "it reads 4.25 in the whole training; train on rows in which it changes, or state its smallest_sd or resolution"
    )
    assert monitor.excluded_signals == {"y0": why}
    assert "shewhart/y1" in names
    assert not any(name.endswith("/y0") for name in names)


def test_an_output_whose_rows_are_too_often_missing_is_left_out_with_the_true_reason() -> None:
    """Every other value of it is missing, so no model of the rows before can predict it; rows do come by one period."""
    values = plant(3, ROWS)
    monitor = Monitor(config_of(3, TRAINING), 0, points=False)
    values[1, ::2] = np.nan
    watch(monitor, values)
    assert monitor.excluded_signals["y0"] == (
        "only 0 of its 300 rows could be predicted, 50 are needed: too often a value is missing in the rows before"
    )
    assert monitor.phase == "watching"


@pytest.mark.parametrize("step", [1e-6, 0.33, 1.0, 250.0])
@pytest.mark.parametrize("offset", [0.0, 0.1, -1e4])
def test_the_resolution_of_a_signal_is_its_smallest_step(step: float, offset: float) -> None:
    counts = np.random.default_rng(1).integers(-50, 50, 400)
    values = np.asarray(offset + step * counts, dtype=np.float64)
    values[::7] = np.nan
    assert resolution(values) == pytest.approx(step, rel=1e-4)


@pytest.mark.parametrize("values", [[], [np.nan], [3.0], [3.0, np.nan, 3.0, 3.0 + 1e-15]])
def test_a_signal_without_a_step_has_no_resolution(values: list[float]) -> None:
    assert resolution(np.array(values, dtype=np.float64)) == 0.0


@pytest.mark.parametrize("share", [0.06, 0.2, 0.37])
def test_what_many_values_do_is_no_outlier(share: float) -> None:
    """Nearly all residuals of a coarse signal are alike, and some are one step off."""
    generator = np.random.default_rng(3)
    z = 0.01 * generator.normal(size=1000) + 0.33 * generator.choice(
        [0.0, 1.0, -1.0], 1000, p=[1 - share, *[share / 2] * 2]
    )
    assert screen_baseline(z, 0.33 / np.sqrt(12.0)).outliers == 0
    assert screen_baseline(z).outliers == 0


@pytest.mark.parametrize("noise_sd", [{"C": 0.0, "T": 0.0}, {"C": 0.0, "T": 0.3}, {"C": 0.002, "T": 0.0}])
def test_a_leak_is_seen_without_noise_and_without_a_smallest_level(noise_sd: dict[str, float]) -> None:
    plant = PlantConfig(seed=5, noise_sd=noise_sd, faults=("coolant_flow:step:-0.05@50min",))
    messages = (encode(item) for item in samples_of(simulate_record(plant, 600), plant.name))
    result = run(messages, MonitorConfig(smallest_sd={}, training_min=40, isolation=False, diagnose_training=False))
    assert min(alarm.raised_ns for alarm, _ in result.raised_alarms) / 60e9 == pytest.approx(50.0, abs=2.0)
