"""`backtest` on any described process: by file, name and columns, learned from its own rows or from another record."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import reactorwatch as rw
from reactorwatch.cli.main import app
from reactorwatch.errors import InputError

TOML = """
name = "rig"
[time]
column = "ts"
unit = "s"
[[signals]]
name = "heat"
column = "H1"
role = "input"
unit = "%"
[[signals]]
name = "flow"
role = "input"
[[signals]]
name = "temperature"
column = "TI-1"
role = "output"
unit = "degC"
[[signals]]
name = "level"
role = "output"
"""
ROWS, FAULT_ROW = 600, 450
COLUMNS = ("--time", "ts", "--input", "H1,flow", "--output", "TI-1", "--output", "level")


def measured(seed: int, rows: int = ROWS, fault: float = 0.0) -> dict[str, np.ndarray[Any, np.dtype[Any]]]:
    """A linear rig with two inputs and two outputs; its temperature steps at a row."""
    generator = np.random.default_rng(seed)
    heat, flow = (np.repeat(generator.normal(size=rows // 10 + 1), 10)[:rows] for _ in range(2))
    temperature, level = np.zeros(rows), np.zeros(rows)
    for row in range(1, rows):
        temperature[row] = 0.9 * temperature[row - 1] + 0.5 * heat[row - 1] + 0.05 * generator.normal()
        level[row] = 0.7 * level[row - 1] + 0.4 * flow[row - 1] + 0.05 * generator.normal()
    temperature[FAULT_ROW:] += fault
    return {"ts": 4.0 * np.arange(float(rows)), "H1": heat, "flow": flow, "TI-1": 20.0 + temperature, "level": level}


def write(path: str, columns: dict[str, np.ndarray[Any, np.dtype[Any]]]) -> None:
    table = np.column_stack(list(columns.values()))
    np.savetxt(path, table, delimiter=",", header=",".join(columns), comments="", fmt="%.9g")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a process, a sound record of it and one with a fault."""
    monkeypatch.chdir(tmp_path)
    Path("rig.toml").write_text(TOML)
    write("sound.csv", measured(1))
    write("faulty.csv", measured(2, fault=2.0))
    return tmp_path


def backtest(*words: str) -> dict[str, Any]:
    result = CliRunner().invoke(app, ["backtest", "--json", *words], standalone_mode=False)
    assert result.exception is None, result.exception
    found: dict[str, Any] = json.loads(result.stdout)
    return found


def refusal(*words: str) -> str:
    result = CliRunner().invoke(app, ["backtest", *words], standalone_mode=False)
    assert isinstance(result.exception, InputError), result.output
    assert "\n" not in str(result.exception)
    return str(result.exception)


@pytest.mark.parametrize(("words", "output"), [(("--process", "rig.toml"), "temperature"), (COLUMNS, "TI-1")])
def test_a_rig_is_watched_with_all_its_inputs_and_a_third_of_its_rows_is_the_training(
    words: tuple[str, ...], output: str
) -> None:
    found = backtest("faulty.csv", *words)
    assert len(found["signals"]["inputs"]) == 2
    assert output in found["signals"]["outputs"]
    assert found["signals"]["left_out"] == []
    assert found["reference"] in ("black-box", "arx")
    assert found["trained_until_min"] == pytest.approx(200 * 4 / 60)
    assert {item["signals"][0] for item in found["alarms"] if item["alarm"].startswith("shewhart")} == {output}
    assert found["alarms"][0]["raised_min"] >= FAULT_ROW * 4 / 60


def test_people_read_how_long_the_training_was() -> None:
    result = CliRunner().invoke(app, ["backtest", "sound.csv", "--process", "rig.toml"], standalone_mode=False)
    assert "training: until 13.3333 min (200 rows)" in result.stdout
    result = CliRunner().invoke(
        app, ["backtest", "faulty.csv", "--process", "rig.toml", "--train", "sound.csv"], standalone_mode=False
    )
    assert "training: on another file (600 rows)" in result.stdout


@pytest.mark.parametrize(
    ("words", "until_min"), [(("--training-rows", "150"), 10.0), (("--training", "12"), 12.0), ((), 200 * 4 / 60)]
)
def test_the_training_is_as_long_as_stated(words: tuple[str, ...], until_min: float) -> None:
    assert backtest("sound.csv", "--process", "rig.toml", *words)["trained_until_min"] == pytest.approx(until_min)


def test_flags_of_the_training_take_the_place_of_a_length_in_the_settings() -> None:
    Path("settings.toml").write_text("[monitor]\ntraining_min = 20.0\n")
    words = ("sound.csv", "--process", "rig.toml", "--config", "settings.toml")
    assert backtest(*words)["trained_until_min"] == pytest.approx(20.0)
    assert backtest(*words, "--training-rows", "150")["trained_until_min"] == pytest.approx(10.0)


def test_the_process_may_be_named_in_the_settings_with_what_concerns_its_signals() -> None:
    Path("settings.toml").write_text('[monitor]\nprocess = "rig.toml"\npriorities = {temperature = "critical"}\n')
    found = backtest("faulty.csv", "--config", "settings.toml")
    assert {item["priority"] for item in found["alarms"] if item["alarm"] == "ewma/temperature"} == {"critical"}


def test_several_files_are_judged_from_their_first_row_by_a_training_on_another() -> None:
    words = ("faulty.csv", "sound.csv", "--train", "sound.csv", "--process", "rig.toml", "--rows", "rows.csv")
    result = CliRunner().invoke(app, ["backtest", "--json", *words], standalone_mode=False)
    faulty, sound = (json.loads(line) for line in result.stdout.splitlines())
    assert faulty["trained_until_min"] == sound["trained_until_min"] == 0.0
    assert faulty["alarms"]
    assert not sound["alarms"]
    with Path("rows.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["file", "row", "time_min", "in_alarm", "raised"]
    assert [(row["file"], int(row["row"])) for row in rows] == [
        (name, row) for name in ("faulty.csv", "sound.csv") for row in range(ROWS)
    ]
    assert [float(row["time_min"]) for row in rows[:ROWS]] == pytest.approx([4.0 / 60 * row for row in range(ROWS)])
    raised = [index for index, row in enumerate(rows) if row["raised"] == "1"]
    assert sorted({item["raised_min"] for item in faulty["alarms"]}) == [float(rows[row]["time_min"]) for row in raised]
    assert raised[0] >= FAULT_ROW
    assert all(rows[row]["in_alarm"] == "1" for row in raised)
    assert {row["in_alarm"] for row in rows[:FAULT_ROW]} == {"0"}


def test_rows_of_the_training_are_in_the_file_without_alarms() -> None:
    backtest("faulty.csv", "--process", "rig.toml", "--rows", "rows.csv")
    with Path("rows.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == ROWS
    assert {(row["in_alarm"], row["raised"]) for row in rows[:200]} == {("0", "0")}


def test_python_finds_the_same_alarms_with_the_process_that_the_record_was_read_with() -> None:
    record = rw.read_record("faulty.csv", process="rig.toml")
    found = rw.backtest(record)
    expected = backtest("faulty.csv", "--process", "rig.toml")
    assert [(item.alarm, item.raised_min) for item in found.alarms] == [
        (item["alarm"], item["raised_min"]) for item in expected["alarms"]
    ]
    assert found.trained_until_min == expected["trained_until_min"]
    assert found.to_dict()["signals"] == expected["signals"]


def test_an_input_that_never_moves_is_named() -> None:
    write("still.csv", measured(1) | {"flow": np.full(ROWS, 3.0)})
    signals = backtest("still.csv", "--process", "rig.toml")["signals"]
    assert signals["inputs"] == ["heat"]
    assert signals["left_out"] == [{"signal": "flow", "why": "it never moves: it reads 3 in all rows"}]


BAD = {
    "two roles for one column": (
        ("sound.csv", "--input", "H1", "--output", "H1"),
        "'H1' for H1 (input) and H1 (output)",
    ),
    "a process and columns": (("sound.csv", "--process", "rig.toml", "--output", "level"), "leave one of the two out"),
    "a unit that does not convert": (("sound.csv", "--process", "bar.toml"), "must convert to 'bar', got 'degC'"),
    "a column that is not there": (("sound.csv", "--output", "nope"), "expected a column 'nope'"),
    "a process that is not there": (("sound.csv", "--process", "nope"), "unknown process 'nope'"),
    "outputs that never change": (("still.csv", "--process", "rig.toml"), "at least one output must change, got"),
    "fewer rows than parameters": (("few.csv", "--process", "rig.toml"), "more than 103 rows to learn 10 parameters"),
    "few rows to train on": (("sound.csv", "--train", "few.csv", "--process", "rig.toml"), "few.csv: must have more"),
    "equations of a process without": (("sound.csv", "--process", "rig.toml", "--reference", "equations"), "got none"),
    "a word that is no reference": (("sound.csv", "--process", "rig.toml", "--reference", "pca"), "auto, equations"),
    "two lengths": (("sound.csv", "--training", "3", "--training-rows", "9"), "leave one out"),
    "a training beside a file": (("sound.csv", "--train", "sound.csv", "--training", "3"), "leave --training and"),
    "rows over a source": (("sound.csv", "--process", "rig.toml", "--rows", "sound.csv"), "sound.csv"),
    "a signal that the process lacks": (("sound.csv", "--process", "rig.toml", "--config", "other.toml"), "'pressure'"),
}


@pytest.mark.parametrize("kind", BAD)
def test_bad_input_gets_one_line_before_any_learning(kind: str) -> None:
    """It names the thing, and nothing is written."""
    words, expected = BAD[kind]
    Path("bar.toml").write_text(TOML.replace('unit = "degC"', 'unit = "bar"').replace("TI-1", "TI-1 [degC]"))
    Path("other.toml").write_text('[monitor]\noutputs = ["pressure"]\n')
    write("still.csv", measured(1) | {"TI-1": np.full(ROWS, 20.0), "level": np.zeros(ROWS)})
    write("few.csv", measured(1, rows=30))
    if kind == "a unit that does not convert":
        write("sound.csv", {name.replace("TI-1", "TI-1 [degC]"): values for name, values in measured(1).items()})
    before = {path: path.read_bytes() for path in Path().iterdir()}
    assert expected in refusal(*words)
    assert {path: path.read_bytes() for path in Path().iterdir()} == before
