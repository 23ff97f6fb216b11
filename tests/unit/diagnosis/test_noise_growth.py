"""A sensor whose noise grows is named with size and onset, alone and beside a cause that changes the outputs."""

import json

import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.identifiability import identifiability
from reactorwatch.diagnosis.record_checks import make_run
from reactorwatch.diagnosis.report.page import as_page
from reactorwatch.diagnosis.result import NAMED, NOMINAL, Diagnosis
from reactorwatch.kalman.batch import FilterRecord
from reactorwatch.kalman.ekf import Filter
from reactorwatch.kalman.ekf_step import NoiseLevels
from reactorwatch.process import effects_of
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.process.generic import generic_effects
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.profiles import STEP
from reactorwatch.records.record import Record
from tests.unit.diagnosis.linear_tank import NOISE_SD, PERIOD_MIN, follows, tank

LEVELS = np.repeat([4.0, 7.0, 3.0, 6.0, 2.0, 8.0, 5.0, 4.0, 6.0, 3.0], 100)
ONSET_MIN = 62.0
OWN_CM = 0.05
"""Noise of a level sensor of the three tanks."""


def record_of(further: float, bias: float = 0.0, seed: int = 3) -> Record:
    """Level of a tank with further noise and a bias from an onset on."""
    rng, time_min = np.random.default_rng(seed), PERIOD_MIN * np.arange(LEVELS.size, dtype=np.float64)
    later = time_min >= ONSET_MIN - 1e-9
    sd = np.where(later, np.hypot(NOISE_SD, further), NOISE_SD)
    level = follows(LEVELS, LEVELS[0]) + sd * rng.standard_normal(LEVELS.size) + bias
    return Record(time_min, {"u": LEVELS, "h": level}, "tank")


@pytest.fixture(scope="module")
def noisier() -> Diagnosis:
    return diagnose(record_of(0.3), tank())


def test_a_noisier_sensor_is_named_with_its_further_noise_and_onset(noisier: Diagnosis) -> None:
    (cause,) = noisier.causes
    assert (noisier.verdict, cause.cause, cause.profile, noisier.location) == (NAMED, "h.noise", "step", "h")
    for name, truth, widest in (("size", 0.3, 0.05), ("onset", ONSET_MIN, 2.0)):
        said = cause.parameters[name]
        assert abs(said.value - truth) < 4.0 * said.sd < 4.0 * widest, name
    extended = parse_extended_model(json.dumps(noisier.extended_model)).build()
    assert extended.parameter("h.noise.size").value == cause.parameters["size"].value


def test_its_report_states_it(noisier: Diagnosis) -> None:
    page = as_page(noisier, tank(), effects_of(tank()), "a.csv", "m.json", "x.csv", on_the_bus=False)
    assert "noisier sensor of h" in page


@pytest.mark.parametrize(("further", "seed"), [(0.0, 3), (0.0, 4), (0.03, 5)])
def test_noise_that_stays_is_nominal(further: float, seed: int) -> None:
    assert diagnose(record_of(further, seed=seed), tank()).verdict == NOMINAL


def test_it_is_named_beside_another_cause() -> None:
    found = diagnose(record_of(0.4, bias=1.0), tank())
    listed = [
        {item.cause for item in found.causes},
        *({cause for cause, _ in item.causes} for item in found.alternatives),
    ]
    assert any({"h.bias", "h.noise"} == item for item in listed)
    assert all("h.noise" in item for item in listed)


def test_the_smallest_noise_that_is_seen_is_found_and_a_third_of_it_is_not() -> None:
    model = tank()
    found = identifiability(model, effects_of(model), make_run(record_of(0.0), model))
    smallest = next(item.smallest for item in found.causes if item.effect.name == "h.noise")
    assert not any("h.noise" in group for group in found.alike)
    assert [item.cause for item in diagnose(record_of(1.3 * smallest), model).causes] == ["h.noise"]
    assert diagnose(record_of(smallest / 3.0), model).verdict == NOMINAL


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
