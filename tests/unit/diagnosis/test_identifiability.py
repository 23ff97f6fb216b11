"""Causes that some sensors and an excitation distinguish, before anything deviates."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from reactorwatch.cli.main import app
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.identifiability import Identifiability, identifiability
from reactorwatch.diagnosis.record_checks import ROWS, excite, make_run
from reactorwatch.diagnosis.result import NOMINAL
from reactorwatch.process import effects_of
from reactorwatch.process.library.cascaded_tanks import EFFECTS as TANK_EFFECTS
from reactorwatch.process.library.cascaded_tanks import tanks
from reactorwatch.records.record import Record
from tests.unit.diagnosis.linear_tank import NOISE_SD, PERIOD_MIN, follows, tank

LEVELS = np.repeat([4.0, 7.0, 3.0, 6.0, 2.0, 8.0, 5.0, 4.0, 6.0, 3.0], 60)


def tank_record(noise_sd: float, gain: float = 1.0) -> Record:
    noise = noise_sd * np.random.default_rng(1).standard_normal(LEVELS.size)
    time_min = PERIOD_MIN * np.arange(LEVELS.size, dtype=np.float64)
    return Record(time_min, {"u": LEVELS, "h": follows(gain * LEVELS, gain * LEVELS[0]) + noise}, "tank")


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
