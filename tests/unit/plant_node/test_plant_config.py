"""The plant's settings: from a file, and what is refused."""

import re
from math import inf
from pathlib import Path
from typing import Any

import msgspec
import pytest

from plant_node.config import PlantConfig, ProcessSettings, fit_settings
from reactorwatch.description.read import DEFAULT_PROCESS, find_process
from reactorwatch.errors import InputError
from reactorwatch.process.library.cstr import EFFECTS
from reactorwatch.process.library.cstr_operation import LevelControl, TemperatureControl
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


def test_a_ramp_may_end_with_the_run() -> None:
    found = fit({"duration_min": 90.0, "faults": ["coolant_flow:ramp:0.1@30min"]})
    assert str(found.faults[0]) == "coolant_flow:ramp:0.1@30min,end=90min"


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
