"""Causes that some sensors and an excitation distinguish, and the noise of a sensor with steps."""

import json
from dataclasses import replace
from math import hypot, sqrt

import numpy as np
import pytest
from typer.testing import CliRunner

from reactorwatch.cli.main import app
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.identifiability import Identifiability, identifiability
from reactorwatch.diagnosis.record_checks import ROWS, excite, make_run
from reactorwatch.diagnosis.result import NOMINAL
from reactorwatch.diagnosis.search.search import Search, smallest_noise
from reactorwatch.process import effects_of
from reactorwatch.process.generic import generic_effects
from reactorwatch.process.library.cascaded_tanks import EFFECTS as TANK_EFFECTS
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.process.library.three_tanks import three_tanks
from reactorwatch.process.model import ProcessModel
from reactorwatch.process.simulate import Simulator
from reactorwatch.records.record import Record
from tests.unit.diagnosis.linear_tank import NOISE_SD, tank, tank_record


def of_tank(noise_sd: float) -> Identifiability:
    model = tank()
    return identifiability(model, effects_of(model), make_run(tank_record(noise_sd), model))


@pytest.fixture(scope="module")
def linear() -> Identifiability:
    return of_tank(NOISE_SD)


def test_what_does_the_same_to_the_sensors_is_alike_and_what_moves_in_time_is_not(linear: Identifiability) -> None:
    group_of = {name: group for group in linear.alike for name in group}
    assert {"u.offset", "shift.deviation", "h.bias", "h.source"} <= set(group_of["u.offset"])
    assert {"u.gain", "gain.deviation"} <= set(group_of["u.gain"])
    assert {"u.lag", "h.lag"} <= set(group_of["u.lag"])
    assert not {"u.lag", "h.delay"} & {*group_of["u.gain"], *group_of["u.offset"]}


def test_the_smallest_sizes_grow_with_the_noise(linear: Identifiability) -> None:
    twice = {item.effect.name: item.smallest for item in of_tank(2.0 * NOISE_SD).causes}
    for item in linear.causes:
        if item.effect.name.endswith((".bias", ".gain", ".offset", ".source", ".deviation")):
            assert twice[item.effect.name] == pytest.approx(2.0 * item.smallest, rel=0.15)


def test_a_cause_is_found_at_its_smallest_size_and_not_at_a_tenth_of_it(linear: Identifiability) -> None:
    smallest = next(item.smallest for item in linear.causes if item.effect.name == "u.gain")
    assert diagnose(tank_record(NOISE_SD, 1.0 + 1.5 * smallest), tank()).verdict != NOMINAL
    assert diagnose(tank_record(NOISE_SD, 1.0 + 0.1 * smallest), tank()).verdict == NOMINAL


def test_a_cause_that_the_excitation_never_reaches_is_invisible() -> None:
    model = tanks()
    record = excite(model)
    assert record.rows == ROWS
    found = identifiability(model, effects_of(model), make_run(record, model))
    assert [item.effect.name for item in found.causes if not item.is_visible] == ["overflow", "lower_overflow"]
    wilder = replace(record, columns={**record.columns, "u": 1.8 * record.columns["u"]})
    found = identifiability(model, effects_of(model), make_run(wilder, model))
    assert [item.effect.name for item in found.causes if not item.is_visible] == ["lower_overflow"]


def test_the_command_prints_the_promised_json_and_a_matrix() -> None:
    printed = CliRunner().invoke(app, ["causes", "--process", "cascaded_tanks", "--json"])
    report = json.loads(printed.output)
    assert list(report) == ["process", "rows", "causes", "smallest_size", "alike", "invisible"]
    assert report["causes"] == [effect.name for effect in TANK_EFFECTS]
    assert report["invisible"] == ["overflow", "lower_overflow"]
    assert set(report["smallest_size"]) == set(report["causes"]) - set(report["invisible"])
    assert report["smallest_size"]["level_bias"]["unit"] == "V"
    matrix = CliRunner().invoke(app, ["causes", "--process", "cascaded_tanks"]).output
    assert "overflow         never" in matrix


PLANTS = {"tanks": (tanks, (1.0, 4.0), [3.0, 3.0]), "three_tanks": (three_tanks, (15.0, 45.0), [40.0, 20.0, 30.0])}


def quantised(name: str, noise_sd: float, step: float) -> tuple[ProcessModel, Record]:
    """Record of a sound plant whose sensors have noise and steps."""
    make, (low, high), start = PLANTS[name]
    model, random, rows = make(), np.random.default_rng(1), 600
    inputs = np.repeat(random.uniform(low, high, (rows // 20, len(model.inputs))), 20, axis=0)
    time_min = 0.1 * np.arange(rows, dtype=np.float64)
    outputs = Simulator(model).run(time_min, inputs, np.array(start)).outputs
    outputs = step * np.round((outputs + noise_sd * random.standard_normal(outputs.shape)) / step)
    columns = dict(zip((*model.input_names, *model.output_names), np.hstack([inputs, outputs]).T, strict=True))
    return model, Record(time_min, columns, name)


@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize(("noise_sd", "step"), [(0.001, 0.1), (0.001, 0.7), (0.05, 0.02), (0.05, 0.1), (0.05, 0.5)])
def test_the_noise_of_a_sensor_in_steps_is_that_of_its_steps_at_least(name: str, noise_sd: float, step: float) -> None:
    model, record = quantised(name, noise_sd, step)
    run = make_run(record, model)
    search = Search(model, (), run, smallest_noise(model, run.measured))
    for sd in search.noise.measurement_sd:
        assert step / sqrt(12.0) * (1.0 - 1e-9) <= sd < 1.35 * hypot(noise_sd, step / sqrt(12.0))


@pytest.mark.slow
def test_a_diagnosis_states_the_noise_of_the_steps() -> None:
    step = 1.0
    model, record = quantised("three_tanks", 0.001, step)
    result = diagnose(record, model)
    for item in result.differences.values():
        assert step / sqrt(12.0) * (1.0 - 1e-9) <= item.noise_sd < 1.35 * step / sqrt(12.0)
    for held_out in result.gain.held_out.values():
        assert held_out.noise_sd >= step / sqrt(12.0) * (1.0 - 1e-9)


def test_a_coarse_sensor_shows_only_larger_causes() -> None:
    model = tanks()
    effects = tuple(item for item in generic_effects(model) if item.name in ("x2.bias", "x2.noise", "u.gain"))
    smallest = []
    for resolution in ({}, {"x2": 1.0}, {"x2": 2.0}):
        record = excite(model, resolution)
        for name, step in resolution.items():
            np.testing.assert_allclose(record.columns[name] / step, np.round(record.columns[name] / step), atol=1e-9)
        found = identifiability(model, effects, make_run(record, model))
        smallest.append({item.effect.name: item.smallest for item in found.causes if item.is_visible})
    for fine, coarse in ((smallest[0], smallest[1]), (smallest[1], smallest[2])):
        assert set(coarse) <= set(fine)
        assert all(coarse[name] > fine[name] for name in coarse)
