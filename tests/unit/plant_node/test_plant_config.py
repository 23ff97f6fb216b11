"""The plant's settings: from a file, from the named runs, and refused ones."""

import re
from math import inf
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec.structs import asdict
from typer.main import get_command

from plant_node.config import PlantConfig, ProcessSettings, fit_settings
from plant_node.record import simulate_record
from reactorwatch.cli.main import app
from reactorwatch.description.read import find_process
from reactorwatch.errors import InputError
from reactorwatch.process import DEFAULT_PROCESS
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import EFFECTS, cstr
from reactorwatch.process.library.cstr_operation import ONSET_MIN, OPERATION, LevelControl, TemperatureControl
from reactorwatch.process.steady_state import steady_states
from reactorwatch.records.record import Record
from reactorwatch.runtime.config import read_settings, section


def read(table: dict[str, Any]) -> PlantConfig:
    return section(PlantConfig, "plant", {"plant": table}, {})


def fit(table: dict[str, Any]) -> ProcessSettings:
    config = read(table)
    return fit_settings(config, find_process(config.process or DEFAULT_PROCESS))


def test_all_settings_go_through_a_file() -> None:
    table = {
        "name": "pilot",
        "period_min": 0.2,
        "speed": inf,
        "duration_min": 60,
        "seed": 7,
        "zero_ns": 1_700_000_000_000_000_000,
        "scenario": {"kind": "square", "low": 95},
        "temperature_control": {"set_point_K": [[0, 438.54], [60, 440]], "gain_l_min_K": 3, "dither": True},
        "level_control": {"gain_per_min": 2},
        "process_noise_sd": {"T": 0.2, "V": 0.5},
        "noise_sd": {"T": 0.1},
        "resolution": {"T": 0.05},
        "valve_limits_l_min": [10, 300],
        "faults": ["coolant_flow:step:-0.05@30min"],
        "start": {"C": 0.1, "T": 438.54},
        "health_period_s": 1,
        "wait_for": ["monitor"],
    }
    config = read(table)
    assert {name: item.noise_sd for name, item in fit(table).sensors.items()} == {"qc": 0.0, "C": 0.002, "T": 0.1}
    assert config.rows == 300
    assert read(msgspec.to_builtins(config)) == config


@pytest.mark.parametrize(
    ("table", "why"),
    [
        ({"name": "a/b"}, "plant name must be 1 to 64 letters, digits, '_', '.' or '-'"),
        ({"period_min": 0.0}, "period_min must be in [0.0001, 60], got 0"),
        ({"speed": 0.0}, "speed must be above 0, or inf for as fast as it goes, got 0"),
        ({"speed": float("nan")}, "speed must be above 0, or inf for as fast as it goes, got nan"),
        ({"duration_min": 0.0}, "duration_min must be above 0, or left out for an endless run, got 0"),
        ({"duration_min": inf}, "duration_min must be above 0, or left out for an endless run, got inf"),
        ({"seed": -1}, "seed must be in [0, 9.22337e+18], got -1"),
        ({"health_period_s": 0.0}, "health_period_s must be in [0.1, 3600], got 0"),
        ({"valve_limits_l_min": [100.0, 90.0]}, "limits of valve_limits_l_min must be two rising numbers, got 100"),
        ({"noise_sd": {"T": -0.1}}, "noise_sd of T must be at least 0, got -0.1"),
        ({"resolution": {"C": inf}}, "resolution of C must be at least 0, got inf"),
        ({"process_noise_sd": {"T": -0.1}}, "process_noise_sd of T must be at least 0, got -0.1"),
        ({"level_control": {"gain_per_min": 0}}, "gain_per_min must be in (0, 1000], got 0"),
        ({"scenario": "sine"}, "scenario: unknown kind 'sine'; did you mean 'sines'?"),
        ({"faults": ["coolant_flow:step:9"]}, "fault 'coolant_flow:step:9': size must be in [-0.99, 4], got 9"),
        (
            {"faults": ["coolant_flow:ramp:0.1"]},
            "fault 'coolant_flow:ramp:0.1': end (when it reaches its size) must be",
        ),
        ({"noise": 0.1}, "unknown key 'noise'; did you mean 'noise_sd'? (valid: name, period_min, "),
    ],
)
def test_wrong_settings_are_named_in_one_line(table: dict[str, Any], why: str) -> None:
    with pytest.raises(InputError) as caught:
        fit(table)
    assert str(caught.value).startswith(f"settings [plant]: {why}")
    assert len(str(caught.value).splitlines()) == 1


PLANT_PAGE = (Path(__file__).parents[3] / "docs" / "plant.md").read_text(encoding="utf-8")


def test_the_controllers_of_the_page_are_taken_and_are_the_defaults(tmp_path: Path) -> None:
    (text,) = re.findall(r"```toml\n(.*?)```", PLANT_PAGE, re.DOTALL)
    path = tmp_path / "settings.toml"
    path.write_text(text, encoding="utf-8")
    config = section(PlantConfig, "plant", read_settings(path), {})
    assert config.temperature_control == TemperatureControl(dither=True)
    assert config.level_control == LevelControl()


def test_the_page_lists_every_cause_and_every_preset() -> None:
    first_cells = re.findall(r"^\| `([a-z_-]+)` \|", PLANT_PAGE, re.MULTILINE)
    assert first_cells == [*(effect.name for effect in EFFECTS), *PlantConfig.presets]


PRESETS = OPERATION.presets
NAMES = [item.name for item in PRESETS]
FAULTY = [name for name in NAMES if name != "fault-free"]
ONSET = round(ONSET_MIN / 0.1)


def read_preset(table: dict[str, Any], **flags: Any) -> PlantConfig:
    return section(PlantConfig, "plant", {"plant": table}, flags)


@pytest.fixture(scope="module")
def records() -> dict[str, Record]:
    return {name: simulate_record(read_preset({"preset": name})) for name in NAMES}


def test_they_are_the_four_records_of_the_work_this_starts_from() -> None:
    assert NAMES == ["fault-free", "input-leakage", "heat-transfer", "reaction-rate"]
    causes = [
        [str(item.effect.name) for item in fit_settings(read_preset({"preset": name}), find_process()).faults]
        for name in NAMES
    ]
    assert causes == [[], ["coolant_flow"], ["heat_transfer"], ["reaction_rate"]]
    assert all(item.meaning for item in PRESETS)


def test_they_differ_in_their_fault_alone() -> None:
    nominal = asdict(read_preset({"preset": "fault-free"}))
    for name in FAULTY:
        settings = asdict(read_preset({"preset": name}))
        assert {key for key in settings if settings[key] != nominal[key]} == {"faults"}


@pytest.mark.parametrize("name", FAULTY)
def test_until_the_fault_sets_in_the_rows_are_the_fault_free_ones(name: str, records: dict[str, Record]) -> None:
    found, nominal = records[name].columns, records["fault-free"].columns
    assert found["T"].size == 4000
    np.testing.assert_array_equal(found["qc"], nominal["qc"])
    for signal in ("C", "T"):
        np.testing.assert_array_equal(found[signal][: ONSET + 1], nominal[signal][: ONSET + 1])
        assert np.any(found[signal][ONSET + 1 :] != nominal[signal][ONSET + 1 :])


@pytest.mark.parametrize(("name", "warmer"), [("input-leakage", 1), ("heat-transfer", 1), ("reaction-rate", -1)])
def test_the_fault_moves_the_operating_point_by_more_than_a_thermometer_s_noise(
    name: str, warmer: int, records: dict[str, Record]
) -> None:
    """By what the steady states at the mean flow say, roughly: the plant is moved about and is not linear."""
    model = parse_fault(read_preset({"preset": name}).faults[0]).extend(cstr())
    before, after = (steady_states(model, np.array([95.0]), time)[-1].outputs[1] for time in (0.0, 300.0))
    expected = after - before
    difference = records[name].columns["T"] - records["fault-free"].columns["T"]
    assert expected * warmer > 3 * 0.3
    assert np.mean(difference[ONSET + 50 :]) == pytest.approx(expected, rel=0.35)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("name", NAMES)
def test_the_plant_stays_on_its_operating_branch(name: str, seed: int) -> None:
    found = simulate_record(read_preset({"preset": name}, seed=seed), 4000).columns["T"]
    assert found.min() > 425.0


def test_the_file_overrides_the_preset_and_a_flag_overrides_both() -> None:
    table = {"preset": "input-leakage", "duration_min": 60.0, "noise_sd": {"T": 0.1}}
    config = read_preset(table, duration_min=30.0)
    assert (config.duration_min, config.noise_sd["T"]) == (30.0, 0.1)
    assert config.faults == ("coolant_flow:step:-0.1@220min",)
    assert read_preset(table).duration_min == 60.0
    assert read_preset(table, preset="heat-transfer").faults == ("heat_transfer:step:-0.5@220min",)
    assert read_preset({"preset": "input-leakage"}, faults=["coolant_flow:step:-0.2@1min"]).faults == (
        "coolant_flow:step:-0.2@1min",
    )


def test_a_stated_default_overrides_the_preset_too() -> None:
    config = read_preset({"preset": "input-leakage", "faults": [], "scenario": "random-steps"})
    assert (config.faults, config.scenario) == ((), PlantConfig().scenario)


@pytest.mark.parametrize(
    ("table", "why"),
    [
        (
            {"preset": "input-leak"},
            "unknown preset 'input-leak'; did you mean 'input-leakage'? "
            "(valid: fault-free, input-leakage, heat-transfer, reaction-rate)",
        ),
        ({"preset": 3}, "unknown preset '3' (valid: fault-free,"),
        ({"pre_set": "fault-free"}, "unknown key 'pre_set'; did you mean 'preset'?"),
    ],
)
def test_an_unknown_preset_is_refused_with_the_valid_ones(table: dict[str, Any], why: str) -> None:
    with pytest.raises(InputError) as caught:
        read_preset(table)
    assert str(caught.value).startswith(f"settings [plant]: {why}")


def test_the_command_names_them_all() -> None:
    option = next(item for item in get_command(app).commands["plant"].params if item.name == "preset")  # type: ignore[attr-defined]
    assert all(name in option.help for name in NAMES)
