"""The inputs: what each looks like, that it depends on time and seed alone, and what is refused."""

from typing import Any

import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from plant_node.scenario import (
    KINDS,
    Constant,
    FromFile,
    HeldRecord,
    RandomSteps,
    Scenario,
    Sines,
    Square,
    check_levels,
    scenario_settings,
)
from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr import cstr
from reactorwatch.process.library.cstr_operation import OPERATION
from reactorwatch.records.record import Record

TIMES = np.round(np.arange(3000) * 0.1, 9)
LEVELS = np.array([100.0, 101.0, 99.0])
QC, LEVELS_OF_QC = cstr().inputs[0], OPERATION.inputs["qc"]
SQUARE = Square(low=95.0, high=105.0, period_min=20.0)
OF_ALL_KINDS: tuple[Scenario, ...] = (
    RandomSteps(low=90.0, high=111.0, hold_min=1.0),
    Sines(mean=100.0, amplitudes=(4.0, 3.0, 2.0), periods_min=(3.1, 7.3, 19.7)),
    SQUARE,
    Constant(100.0),
    HeldRecord.of(Record(np.array([0.1, 0.3, 0.4]), {"qc": LEVELS}, "test"), QC),
)


def test_the_reactor_has_the_documented_defaults() -> None:
    kinds = ("random-steps", "sines", "square", "constant")
    assert tuple(scenario_settings(kind, LEVELS_OF_QC) for kind in kinds) == OF_ALL_KINDS[:4]


def levels(scenario: Scenario, seed: int = 0) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([scenario.level(float(time_min), seed) for time_min in TIMES])


def test_every_kind_of_the_catalogue_is_tested_here() -> None:
    assert {type(item) for item in OF_ALL_KINDS} - {HeldRecord} == set(KINDS.values()) - {FromFile}


@pytest.mark.parametrize("scenario", OF_ALL_KINDS, ids=lambda scenario: type(scenario).__name__)
def test_a_level_does_not_depend_on_what_was_asked_before(scenario: Scenario) -> None:
    forwards = levels(scenario)
    backwards = [scenario.level(float(time_min), 0) for time_min in TIMES[::-1]]
    np.testing.assert_array_equal(backwards[::-1], forwards)


@pytest.mark.parametrize("scenario", ["random-steps", "sines", "square", "constant"])
def test_by_default_the_nominal_plant_stays_on_its_operating_branch(scenario: str) -> None:
    """The operating branch at 85 to 111 l/min lies above 430 K, the middle one below 410 K."""
    config = PlantConfig(duration_min=300.0, scenario=scenario, noise_sd={"C": 0, "T": 0})
    record = simulate_record(config)
    assert record.columns["T"].min() > 420
    assert record.columns["T"].max() < 460


def test_random_steps_hold_and_fill_their_range() -> None:
    found = levels(RandomSteps(low=90.0, high=111.0, hold_min=1.0)).reshape(300, 10)
    assert np.all(found == found[:, :1])
    steps = found[:, 0]
    assert np.unique(steps).size == 300
    assert 90 <= steps.min() < 91
    assert 110 < steps.max() <= 111
    assert abs(steps.mean() - 100.5) < 4 * 21 / np.sqrt(12 * 300)
    assert abs(np.corrcoef(steps[1:], steps[:-1])[0, 1]) < 4 / np.sqrt(300)


def test_sines_match_their_stated_sum() -> None:
    scenario = Sines(mean=100.0, amplitudes=(4.0, 2.0), periods_min=(3.0, 7.0), phases=(0.0, 1.0))
    expected = 100 + 4 * np.sin(2 * np.pi * TIMES / 3) + 2 * np.sin(2 * np.pi * TIMES / 7 + 1)
    np.testing.assert_allclose(levels(scenario), expected, rtol=1e-12)


def test_square_wave_is_half_low_half_high() -> None:
    found = levels(Square(low=95.0, high=105.0, period_min=20.0)).reshape(15, 200)
    assert np.all(found[:, :100] == 95.0)
    assert np.all(found[:, 100:] == 105.0)


def test_a_record_is_held_between_its_rows_and_after_its_end() -> None:
    held = HeldRecord.of(Record(np.array([5.0, 5.3, 6.0]), {"qc": LEVELS}, "test"), QC)
    found = [held.level(time_min, 0) for time_min in (0.0, 0.29, 0.3, 0.99, 1.0, 1e6)]
    assert found == [100.0, 100.0, 101.0, 101.0, 99.0, 99.0]


def test_a_record_that_cannot_drive_is_refused() -> None:
    times = np.array([0.0, 0.1, 0.2])
    with pytest.raises(InputError, match=r"^x.csv: must have a column 'qc' with at least one row to drive the plant$"):
        HeldRecord.of(Record(times, {"T": LEVELS}, "x.csv"), QC)
    with pytest.raises(InputError, match=r"^x.csv: qc must be a number of at least 0 l/min .*, got nan at 0.1 min$"):
        HeldRecord.of(Record(times, {"qc": np.array([100.0, np.nan, 100.0])}, "x.csv"), QC)


@pytest.mark.parametrize(
    ("said", "settings"),
    [
        ("square", SQUARE),
        ({"kind": "constant", "level_l_min": 98.0}, Constant(98.0)),
        ({"kind": "constant", "level": 98.0}, Constant(98.0)),
        ("runs/input.CSV", FromFile(path="runs/input.CSV")),
        ({"kind": "random-steps", "low": 95, "hold_min": 2.5}, RandomSteps(95.0, 111.0, 2.5)),
        ({"kind": "sines", "amplitudes": [3], "periods_min": [5.0]}, Sines(100.0, (3.0,), (5.0,))),
    ],
)
def test_settings_name_a_scenario(said: str | dict[str, Any], settings: object) -> None:
    assert scenario_settings(said, LEVELS_OF_QC) == settings


@pytest.mark.parametrize(
    ("said", "why"),
    [
        (
            "squares",
            "scenario: unknown kind 'squares'; did you mean 'square'? "
            "(valid: random-steps, sines, square, constant, file)",
        ),
        ({"low": 1.0}, "scenario must have a 'kind' (valid: random-steps, sines, square, constant, file)"),
        (
            {"kind": "square", "hihg": 1.0},
            "scenario square: unknown key 'hihg'; did you mean 'high'? (valid: low, high, period_min)",
        ),
        ("file", "scenario file: 'path' must say which record drives the plant"),
        ({"kind": "square", "low": "x"}, "scenario square: Expected `float`, got `str` - at `$.low`"),
        ({"kind": "square", "low": 106.0}, "scenario square: low must not exceed high, got 106 and 105"),
        ({"kind": "constant", "level_l_min": -1.0}, "scenario constant: level must be in [0, 500] l/min, got -1"),
        ({"kind": "random-steps", "hold_min": 0.0}, "scenario random-steps: hold_min must be above 0 min, got 0"),
        ({"kind": "sines", "mean": 5.0}, "scenario sines: mean - amplitudes must be in [0, 500] l/min, got -4"),
        ({"kind": "sines", "phases": [0.0]}, "scenario sines: phases must be as many as amplitudes, 3, got 1"),
    ],
)
def test_wrong_settings_are_named_in_one_line(said: str | dict[str, Any], why: str) -> None:
    with pytest.raises(InputError) as caught:
        check_levels(scenario_settings(said, LEVELS_OF_QC), QC)
    assert str(caught.value).startswith(why)
    assert len(str(caught.value).splitlines()) == 1
