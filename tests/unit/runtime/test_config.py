"""Settings: defaults, then the file, then the flags; and one clear line for whatever is wrong."""

from pathlib import Path

import msgspec
import pytest

from diagnosis_node.trigger import DiagnosisConfig
from monitor_node.config import MonitorConfig
from plant_node.config import PlantConfig
from reactorwatch.cli.processes import write_settings
from reactorwatch.errors import InputError
from reactorwatch.runtime.config import SECTIONS, BusConfig, read_settings, section
from recorder.config import RecorderConfig, ReplayConfig


def settings_file(folder: Path, text: str) -> Path:
    path = folder / "settings.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_flags_outdo_the_file_and_the_file_the_defaults(tmp_path: Path) -> None:
    tables = read_settings(settings_file(tmp_path, "[monitor]\norder = 2\ntraining_min = 50.0\n"))
    config = section(MonitorConfig, "monitor", tables, {"order": 4, "forgetting": None})
    assert (config.order, config.training_min, config.forgetting) == (4, 50.0, MonitorConfig().forgetting)


def test_without_a_file_all_is_default() -> None:
    assert section(BusConfig, "bus", read_settings(None), {}) == BusConfig()


def test_the_bus_is_on_loopback_unless_asked() -> None:
    assert BusConfig().endpoint == "tcp/127.0.0.1:7447"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[monitr]\n", "unknown table 'monitr'; did you mean 'monitor'? (valid: bus, plant, monitor"),
        (
            "[monitor]\ntraning_min = 1\n",
            "unknown key 'traning_min'; did you mean 'training_min'? (valid: ewma_weight,",
        ),
        ("[monitor]\ntraining_min = 'long'\n", "training_min"),
        ("[monitor]\ntraining_min = -5.0\n", "training_min must be in [0.001, 1e+06], got -5"),
        ("monitor = 3\n", "'monitor' must be a table, like [monitor]"),
        ("[monitor\n", "is not TOML"),
        ("[monitor]\nplant = 'a/b'\n", "plant name must be"),
    ],
)
def test_an_error_is_reported_in_one_line(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        section(MonitorConfig, "monitor", read_settings(settings_file(tmp_path, text)), {})
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.toml: cannot be read: No such file"):
        read_settings(tmp_path / "nowhere.toml")


@pytest.mark.parametrize("endpoint", ["localhost", "127.0.0.1:7447", "tcp/localhost", "a/b/c:1"])
def test_an_endpoint_that_is_none_is_refused(endpoint: str) -> None:
    with pytest.raises(InputError, match=r"endpoint must be like 'tcp/127.0.0.1:7447'"):
        section(BusConfig, "bus", {}, {"endpoint": endpoint})


def test_every_node_has_a_table() -> None:
    nodes = {"bus", "plant", "monitor", "fleet", "recorder", "replay", "diagnosis", "metrics", "log", "limits"}
    assert set(SECTIONS) == nodes


def test_settings_that_are_written_are_read_as_they_were(tmp_path: Path) -> None:
    written: dict[str, msgspec.Struct] = {
        "bus": BusConfig(endpoint="tcp/127.0.0.1:9999"),
        "plant": PlantConfig(speed=float("inf"), faults=("coolant_flow:step:-0.1@30min",), duration_min=60.0),
        "monitor": MonitorConfig(order=2),
        "recorder": RecorderConfig(out="somewhere"),
        "replay": ReplayConfig(file="a.csv"),
        "diagnosis": DiagnosisConfig(out="reports", tolerance={"T": 0.5}),
    }
    path = tmp_path / "settings.toml"
    write_settings(path, written)
    tables = read_settings(path)
    for name, settings in written.items():
        assert section(type(settings), name, tables, {}) == settings


def test_a_key_that_has_no_effect_any_more_is_still_read() -> None:
    tables = {"monitor": {"alarm_state_file": "alarms.state", "state_file": "monitor.state"}}
    assert section(MonitorConfig, "monitor", tables, {}).state_file == "monitor.state"


def test_an_older_name_of_a_key_is_valid_and_both_together_are_not() -> None:
    assert section(MonitorConfig, "monitor", {"monitor": {"input": "u"}}, {}).inputs == ("u",)
    assert section(MonitorConfig, "monitor", {"monitor": {"input": "u"}}, {"inputs": ("a", "b")}).inputs == ("a", "b")
    with pytest.raises(InputError, match=r"'input' is an older name of 'inputs', got both; leave 'input' out"):
        section(MonitorConfig, "monitor", {"monitor": {"input": "u", "inputs": ["u"]}}, {})
