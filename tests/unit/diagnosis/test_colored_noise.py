"""Coloured sensor noise is distinguished from white noise and from disturbances of the plant, and is estimated."""

from math import exp, log, sqrt

import numpy as np
import pytest
from scipy.signal import lfilter

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.fitting.colored_noise import Noise, detect_colored_noise
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.run import Run
from reactorwatch.process.library.cstr import OPERATING_STATE, cstr
from reactorwatch.process.simulate import Simulator

NAMES = ("C", "T")
WHITE = Noise((0.002, 0.3), (0.0, 0.0))
SMALLEST = (1e-4, 1e-2)


def autoregressive(kept: float, rows: int, seed: int) -> Array:
    """Noise of unit variance, shape (rows,)."""
    white = np.random.default_rng(seed).standard_normal(rows + 200)
    return np.asarray(lfilter([sqrt(1.0 - kept**2)], [1.0, -kept], white)[200:])


def wandering_in(residual: Array) -> list[str]:
    return [item.output for item in detect_colored_noise(WHITE, NAMES, residual, 0.1)]


@pytest.mark.parametrize(("rows", "kept"), [(1500, 0.5), (1500, 0.8), (7500, 0.35)])
def test_an_output_is_suspected_where_its_noise_remembers(rows: int, kept: float) -> None:
    for seed in range(20):
        residual = np.stack([autoregressive(0.0, rows, 100 + seed), autoregressive(kept, rows, seed)], axis=1)
        assert wandering_in(residual) == ["T"]


def test_what_moves_the_plant_and_what_a_model_lacks_is_not_suspected() -> None:
    rows = 3000
    plant = autoregressive(0.95, rows, 1) + np.exp(-(np.arange(rows) % 10) / 8.0)
    for seed in range(20):
        white = np.stack([autoregressive(0.0, rows, seed + place) for place in (100, 200)], axis=1)
        assert wandering_in(white) == []
        assert wandering_in(white + plant[:, None] * [0.0, 1.0]) == []
        white[::7] = np.nan
        assert wandering_in(white) == []


def coloured(kept: float, rows: int, seed: int) -> Run:
    """A nominal run whose thermometer has such noise of 0.3 K."""
    random = np.random.default_rng(seed)
    time_min: Array = 0.1 * np.arange(rows, dtype=np.float64)
    flow = np.repeat(random.uniform(92.0, 108.0, rows // 10), 10)
    true = Simulator(cstr()).run(time_min, flow, np.array(OPERATING_STATE)).outputs
    noise = np.stack([0.002 * autoregressive(0.0, rows, seed + 1), 0.3 * autoregressive(kept, rows, seed + 2)], axis=1)
    return Run(time_min, flow[:, None], true + noise)


@pytest.mark.parametrize("kept", [0.4, 0.7])
def test_its_size_and_memory_are_learned_and_what_is_left_is_white(kept: float) -> None:
    rows = 2000
    run = coloured(kept, rows, seed=4)
    begin = detect_colored_noise(WHITE, NAMES, FaultFilter(cstr(), (), WHITE).evaluate(run, ())[2].residual, 0.1)
    ekf = FaultFilter(cstr(), (), Noise(WHITE.measurement_sd, WHITE.process_sd, begin))
    ekf.noise = noise = ekf.estimate_noise(run, (), SMALLEST)
    (thermometer,) = noise.colored
    assert noise.process_sd == (0.0, 0.0)
    # of an autoregression the coefficient is known to sqrt((1 - kept^2) / rows), its variance to less
    found = exp(-0.1 / thermometer.time_min) * thermometer.sd**2 / noise.sensor_sd(NAMES)[1] ** 2
    assert found == pytest.approx(kept, abs=5.0 * sqrt((1.0 - kept**2) / rows))
    inflated = sqrt((1.0 + kept) / (1.0 - kept) / (2.0 * rows))
    assert log(noise.sensor_sd(NAMES)[1] / 0.3) == pytest.approx(0.0, abs=4.0 * inflated)
    w = ekf.evaluate(run, ())[1][100:, 1]
    assert abs(float(np.corrcoef(w[1:], w[:-1])[0, 1])) < 4.0 / sqrt(rows)


def test_white_sensors_cost_the_filter_no_state() -> None:
    assert FaultFilter(cstr(), (), WHITE).model.state_names == NAMES
