"""Sensor noise beside model error, coloured noise beside white, and a sensor whose noise grows as a cause."""

import json
from collections.abc import Callable
from dataclasses import replace
from math import exp, log, sqrt

import numpy as np
import pytest
from scipy.signal import lfilter

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.arrays import Array
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.fitting.colored_noise import (
    ColoredNoise,
    Noise,
    detect_colored_noise,
    estimate_sensor_noise,
)
from reactorwatch.diagnosis.fitting.fault_filter import FaultFilter
from reactorwatch.diagnosis.identifiability import identifiability
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.report.page import as_page
from reactorwatch.diagnosis.result import NAMED, NOMINAL, UNKNOWN, Diagnosis
from reactorwatch.diagnosis.run import Run
from reactorwatch.kalman.batch import FilterRecord
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process import effects_of
from reactorwatch.process.effect import Effect
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.process.generic import generic_effects
from reactorwatch.process.library.cstr import EFFECTS, OPERATING_STATE, cstr
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.profiles import STEP
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record
from tests.unit.diagnosis.linear_tank import NOISE_SD, PERIOD_MIN, follows, tank
from tests.unit.diagnosis.runs import record_of

NAMES = ("C", "T")
WHITE = Noise((0.002, 0.3), (0.0, 0.0))
SMALLEST = (1e-4, 1e-2)


def noise_with_memory(kept: float, rows: int, seed: int) -> Array:
    """Noise of unit variance, shape (rows,)."""
    white = np.random.default_rng(seed).standard_normal(rows + 200)
    return np.asarray(lfilter([sqrt(1.0 - kept**2)], [1.0, -kept], white)[200:])


def wandering_in(residual: Array) -> list[str]:
    return [item.output for item in detect_colored_noise(WHITE, NAMES, residual, 0.1)]


@pytest.mark.parametrize(("rows", "kept"), [(1500, 0.5), (1500, 0.8), (7500, 0.35)])
def test_an_output_is_suspected_where_its_noise_remembers(rows: int, kept: float) -> None:
    for seed in range(20):
        residual = np.stack([noise_with_memory(0.0, rows, 100 + seed), noise_with_memory(kept, rows, seed)], axis=1)
        assert wandering_in(residual) == ["T"]


def test_what_moves_the_plant_and_what_a_model_lacks_is_not_suspected() -> None:
    rows = 3000
    plant = noise_with_memory(0.95, rows, 1) + np.exp(-(np.arange(rows) % 10) / 8.0)
    for seed in range(20):
        white = np.stack([noise_with_memory(0.0, rows, seed + place) for place in (100, 200)], axis=1)
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
    noise = np.stack(
        [0.002 * noise_with_memory(0.0, rows, seed + 1), 0.3 * noise_with_memory(kept, rows, seed + 2)], axis=1
    )
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


ROWS = 3000


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


LEVELS = np.repeat([4.0, 7.0, 3.0, 6.0, 2.0, 8.0, 5.0, 4.0, 6.0, 3.0], 100)
ONSET_MIN = 62.0
OWN_CM = 0.05
"""Noise of a level sensor of the three tanks."""


def noisy_record(further: float, bias: float = 0.0, seed: int = 3) -> Record:
    """Level of a tank with further noise and a bias from an onset on."""
    rng, time_min = np.random.default_rng(seed), PERIOD_MIN * np.arange(LEVELS.size, dtype=np.float64)
    later = time_min >= ONSET_MIN - 1e-9
    sd = np.where(later, np.hypot(NOISE_SD, further), NOISE_SD)
    level = follows(LEVELS, LEVELS[0]) + sd * rng.standard_normal(LEVELS.size) + bias
    return Record(time_min, {"u": LEVELS, "h": level}, "tank")


@pytest.fixture(scope="module")
def noisier() -> Diagnosis:
    return diagnose(noisy_record(0.3), tank())


def test_a_noisier_sensor_is_named_with_its_further_noise_and_onset(noisier: Diagnosis) -> None:
    (cause,) = noisier.causes
    assert (noisier.verdict, cause.cause, cause.profile, noisier.location) == (NAMED, "h.noise", "step", "h")
    for name, truth, widest in (("size", 0.3, 0.05), ("onset", ONSET_MIN, 2.0)):
        stated = cause.parameters[name]
        assert abs(stated.value - truth) < 4.0 * stated.sd < 4.0 * widest, name
    extended = parse_extended_model(json.dumps(noisier.extended_model)).build()
    assert extended.parameter("h.noise.size").value == cause.parameters["size"].value


def test_its_report_states_it(noisier: Diagnosis) -> None:
    page = as_page(noisier, tank(), effects_of(tank()), "a.csv", "m.json", "x.csv", on_the_bus=False)
    assert "noisier sensor of h" in page


@pytest.mark.parametrize(("further", "seed"), [(0.0, 3), (0.0, 4), (0.03, 5)])
def test_noise_that_stays_is_nominal(further: float, seed: int) -> None:
    assert diagnose(noisy_record(further, seed=seed), tank()).verdict == NOMINAL


def test_it_is_named_beside_another_cause() -> None:
    found = diagnose(noisy_record(0.4, bias=1.0), tank())
    listed = [
        {item.cause for item in found.causes},
        *({cause for cause, _ in item.causes} for item in found.alternatives),
    ]
    assert any({"h.bias", "h.noise"} == item for item in listed)
    assert all("h.noise" in item for item in listed)


def test_the_smallest_noise_that_is_seen_is_found_and_a_third_of_it_is_not() -> None:
    model = tank()
    found = identifiability(model, effects_of(model), make_run(noisy_record(0.0), model))
    smallest = next(item.smallest for item in found.causes if item.effect.name == "h.noise")
    assert not any("h.noise" in group for group in found.alike)
    assert [item.cause for item in diagnose(noisy_record(1.3 * smallest), model).causes] == ["h.noise"]
    assert diagnose(noisy_record(smallest / 3.0), model).verdict == NOMINAL


def test_a_filter_of_the_extended_model_expects_the_noise_from_the_onset_on() -> None:
    effect = next(item for item in generic_effects(three_tanks()) if item.name == "h2.noise")
    model = effect.extend(three_tanks(), STEP).with_values({"h2.noise.size": 0.4, "h2.noise.onset": 1.0})
    time_min, inputs = 0.1 * np.arange(30.0), np.tile([30.0, 20.0], (30, 1))
    noise = NoiseLevels((0.3, 0.3, 0.3), (0.0, 0.0, 0.0))
    measured = np.tile([40.0, 20.0, 30.0], (30, 1))
    sd = Filter(model, noise).run(FilterRecord(time_min, inputs, measured)).sd
    without = Filter(three_tanks(), noise).run(FilterRecord(time_min, inputs, measured)).sd
    np.testing.assert_array_equal(sd[1:10], without[1:10])
    np.testing.assert_allclose(sd[10], np.sqrt(without[10] ** 2 + [0.0, 0.16, 0.0]), rtol=1e-9)


def test_the_plant_injects_it() -> None:
    levels = {"Q1": {"kind": "square"}, "Q2": {"kind": "square"}}
    plain, noisy = (
        simulate_record(
            PlantConfig(
                process="three_tanks", duration_min=60.0, seed=5, open_loop=True, scenario=levels, faults=faults
            )
        )
        for faults in ((), ("h2.noise:step:0.5@30min",))
    )
    change, later = noisy.columns["h2"] - plain.columns["h2"], plain.time_min >= 30.0
    assert np.all(change[~later] == 0.0)
    assert np.std(change[later]) == pytest.approx(np.hypot(OWN_CM, 0.5) - OWN_CM, rel=0.15)
    np.testing.assert_array_equal(noisy.columns["h1"], plain.columns["h1"])
