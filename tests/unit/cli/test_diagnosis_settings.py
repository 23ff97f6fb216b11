"""Settings of diagnoses after alarms, from the settings file, the flags and the monitor."""

from pathlib import Path
from typing import Any

import pytest

from diagnosis_node.trigger import DiagnosisConfig
from monitor_node.config import MonitorConfig
from reactorwatch.cli.up import diagnosis_settings
from reactorwatch.errors import InputError

MODEL = '{"format": "reactorwatch.model.v1", "model": "cstr"}'


def test_plant_and_model_are_those_of_the_monitor(tmp_path: Path) -> None:
    (tmp_path / "known.json").write_text(MODEL)
    monitor = MonitorConfig(plant="unit_2", process=str(tmp_path / "known.json"))
    found = diagnosis_settings({}, monitor, tmp_path / "reports")
    assert found == DiagnosisConfig(plant="unit_2", out=str(tmp_path / "reports"), process=monitor.process)


def test_settings_override_the_default_and_a_flag_overrides_both(tmp_path: Path) -> None:
    table = {"out": "here", "after_min": 12.0}
    assert diagnosis_settings({"diagnosis": table}, MonitorConfig(), None) == DiagnosisConfig(out="here", after_min=12)
    assert diagnosis_settings({"diagnosis": table}, MonitorConfig(), tmp_path).out == str(tmp_path)


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"out": "FILE"}, "FILE: is a file, the name of a folder was expected"),
        ({"out": "new", "model": "none.json"}, "none.json: there is no such file"),
        ({"after": 3}, r"unknown key 'after'; did you mean 'after_min'\?"),
        ({"window_min": 10.0}, r"window_min must be in \[20, 1e\+06\], got 10"),
    ],
)
def test_an_impossible_setting_is_reported_before_anything_runs(
    table: dict[str, Any], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("FILE").write_text("")
    with pytest.raises(InputError, match=said):
        diagnosis_settings({"diagnosis": table}, MonitorConfig(), None)
