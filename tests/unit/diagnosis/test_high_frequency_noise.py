"""Model error is not taken for sensor noise, so that it can matter in practice."""

from collections.abc import Callable
from dataclasses import replace
from math import sqrt

import numpy as np
import pytest
from scipy.signal import lfilter

from reactorwatch.arrays import Array
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.fitting.colored_noise import ColoredNoise, Noise, estimate_sensor_noise
from reactorwatch.diagnosis.result import UNKNOWN
from reactorwatch.process.effect import Effect
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.records.record import Record
from tests.unit.diagnosis.runs import record_of

ROWS, PERIOD_MIN = 3000, 0.1


def white(seed: int) -> Array:
    return np.random.default_rng(seed).standard_normal(ROWS)


def autoregressive(kept: float, seed: int) -> Array:
    """First-order autoregression of unit variance."""
    return np.asarray(lfilter([sqrt(1.0 - kept**2)], [1.0, -kept], white(seed)))


def plant_like(seed: int) -> Array:
    """Unit variance: the response to an input's moves with a time constant of ten rows."""
    moves = np.repeat(np.random.default_rng(seed).standard_normal(ROWS // 20), 20)
    results = lfilter([0.1], [1.0, -0.9], lfilter([0.1], [1.0, -0.9], moves))
    return np.asarray(results / np.std(results))


def estimated(residual: Array, noise: Noise) -> float:
    return float(estimate_sensor_noise(noise, ("y",), residual[:, None], residual[:, None], PERIOD_MIN)[0])


@pytest.mark.parametrize("error", [0.0, 0.5, 3.0, 10.0])
def test_white_noise_is_found_beside_an_error_of_any_size(error: float) -> None:
    residual = white(1) + error * plant_like(2)
    swallowed = Noise((float(np.std(residual)),), (0.0,))
    assert estimated(residual, swallowed) == pytest.approx(1.0, rel=0.15)


@pytest.mark.parametrize("kept", [0.4, 0.7])
@pytest.mark.parametrize("error", [0.0, 3.0])
def test_noise_with_memory_counts_and_an_error_that_passes_for_it_does_not(kept: float, error: float) -> None:
    residual = white(3) + 2.0 * autoregressive(kept, 4) + error * plant_like(5)
    time_min = -PERIOD_MIN / np.log(kept)
    memory = ColoredNoise("y", float(np.hypot(2.0, error)), time_min, 1.0, 1.0)
    assert estimated(residual, Noise((1.0,), (0.0,), (memory,))) == pytest.approx(sqrt(5.0), rel=0.2)


def test_the_noise_is_never_larger_than_the_filters_and_rounding_is_part_of_it() -> None:
    assert estimated(white(6), Noise((0.5,), (0.0,))) == 0.5
    slow = 0.01 * np.arange(ROWS, dtype=np.float64)
    rounded = np.round(slow)[:, None]
    found = estimate_sensor_noise(Noise((9.0,), (0.0,)), ("y",), rounded - slow[:, None], rounded, PERIOD_MIN)
    assert found[0] == pytest.approx(1.0 / sqrt(12.0), rel=0.3)


def changed(record: Record, name: str, change: Callable[[Record], Array]) -> Record:
    return replace(record, columns=record.columns | {name: change(record)})


BIAS = tuple(effect for effect in EFFECTS if effect.name == "concentration_bias")


@pytest.mark.parametrize(
    ("slope", "catalogue", "tolerance", "practical"),
    [
        (0.0009, BIAS, 0.0015, True),
        (0.0009, (), 0.0015, True),
        (-0.0015, (), 0.0015, True),
        (0.0009, (), 0.02, False),
    ],
)
def test_an_analyser_that_feels_the_temperature_matters_beyond_the_tolerance(
    slope: float, catalogue: tuple[Effect, ...], tolerance: float, practical: bool
) -> None:
    record = record_of(rows=1500)
    record = changed(record, "C", lambda r: r.columns["C"] + slope * (r.columns["T"] - 440.0))
    found = diagnose(record, cstr(), catalogue, tolerance={"C": tolerance})
    assert (found.verdict, found.practical) == (UNKNOWN, practical)
    gain = found.gain.held_out["C"]
    assert gain.noise_sd == found.differences["C"].noise_sd == pytest.approx(0.002, rel=0.1)
    assert gain.rmse_before > 2.0 * gain.noise_sd
