"""Bounds never hide a fault: the check of the range sees what is out of them, on every path and wherever they stand."""

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import reactorwatch as rw
from monitor_node.replay import backtest
from monitor_node.watched_process import load_process
from reactorwatch.api.monitor import monitor_settings
from reactorwatch.cli.main import app
from reactorwatch.contract.codec import encode
from reactorwatch.description.read import ProcessChoice
from reactorwatch.records.write import write_table
from reactorwatch.results.backtest import Backtest
from recorder.config import ReplayConfig
from recorder.tools.convert import export_csv, import_csv
from recorder.tools.replay import open_tape

ROWS, JUMP = 240, 180
BOUNDS = {"level": (50.0, 120.0), "valve": (0.0, 100.0)}


class Plant(NamedTuple):
    """A plant whose signal jumps out of its bounds.

    Attributes:
        signal: name of the signal.
        frame: the rows as they were sampled.
        process: file that describes the plant.
        settings: settings of the monitor.
        folder: folder for files.
    """

    signal: str
    frame: pd.DataFrame
    process: Path
    settings: dict[str, Any]
    folder: Path

    @property
    def table(self) -> Path:
        """The rows in a file."""
        path = self.folder / "rows.csv"
        self.frame.to_csv(path, index=False)
        return path

    def recording(self) -> Path:
        """The rows in a recording."""
        import_csv(self.table, self.folder / "rows.mcap", choice=ProcessChoice(str(self.process)))
        return self.folder / "rows.mcap"

    def watch(self, messages: Any) -> Backtest:
        """A monitor over samples from the bus."""
        config, model = load_process(monitor_settings({"process": str(self.process), "plant": "rig", **self.settings}))
        return backtest.run(map(encode, messages), config, 0, model)


def describe(path: Path, signal: str, *, bounded: bool, as_code: bool) -> Path:
    """Write a file that describes the plant."""
    roles = {"level": "output"} if signal == "level" else {"valve": "input", "level": "output"}
    if as_code:
        bounds = {name: f", bounds={BOUNDS[name]}" if bounded and name == signal else "" for name in roles}
        signals = "".join(f"    Signal({n!r}, '%', {role!r}{bounds[n]}),\n" for n, role in roles.items())
        path = path.with_suffix(".py")
        path.write_text(
            "from reactorwatch import Process, Signal\n\n"
            f"def process():\n    return Process('rig', (\n{signals}    ))\n"
        )
        return path
    bounds = {name: f"bounds = {list(BOUNDS[name])}\n" if bounded and name == signal else "" for name in roles}
    text = "".join(f'[[signals]]\nname = "{n}"\nunit = "%"\nrole = "{role}"\n{bounds[n]}' for n, role in roles.items())
    path.write_text('name = "rig"\n[time]\ncolumn = "time_min"\n' + text)
    return path


PLACES = {
    "toml": (True, False, False),
    "code": (True, True, False),
    "settings": (False, False, True),
    "settings beside code": (False, True, True),
}
"""Places of the bounds: in the description, a description of Python, the settings."""


@pytest.fixture(params=[(place, signal) for place in PLACES for signal in BOUNDS], ids="-".join)
def plant(request: pytest.FixtureRequest, tmp_path: Path) -> Plant:
    """A plant with its bounds in one of the places; an input or an output jumps."""
    place, signal = request.param
    generator = np.random.default_rng(3)
    valve = 40.0 + np.repeat(generator.normal(size=ROWS // 4), 4)
    values = {"level": 80.0 + generator.normal(size=ROWS), "valve": valve}
    values[signal][JUMP:] = 140.0
    names = ["level"] if signal == "level" else ["valve", "level"]
    frame = pd.DataFrame({"time_min": np.arange(ROWS) / 6.0} | {name: values[name].round(3) for name in names})
    in_file, as_code, in_settings = PLACES[place]
    process = describe(tmp_path / "rig.toml", signal, bounded=in_file, as_code=as_code)
    settings = {"training_rows": 80} | ({"bounds": {signal: BOUNDS[signal]}} if in_settings else {})
    return Plant(signal, frame, process, settings, tmp_path)


def backtest_command(plant: Plant, file: Path) -> Any:
    lines = [f"training_rows = {plant.settings['training_rows']}\n"]
    lines += [f"bounds = {{{name} = {list(pair)}}}\n" for name, pair in plant.settings.get("bounds", {}).items()]
    (plant.folder / "settings.toml").write_text("[monitor]\n" + "".join(lines))
    options = ["--process", str(plant.process), "--config", str(plant.folder / "settings.toml"), "--json"]
    result = CliRunner().invoke(app, ["backtest", str(file), *options])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    return found["samples"], [(item["alarm"], item["raised_min"]) for item in found["alarms"]]


def of_record(plant: Plant, record: rw.Record) -> Any:
    found = rw.backtest(record, **plant.settings)
    return found.samples, [(item.alarm, item.raised_min) for item in found.alarms]


def of_messages(plant: Plant, messages: Any) -> Any:
    found = plant.watch(messages)
    return found.samples, [(item.alarm, item.raised_min) for item in found.alarms]


def two_files(plant: Plant) -> Any:
    parts = [plant.folder / "first.csv", plant.folder / "second.csv"]
    for path, (first, end) in zip(parts, pairwise((0, JUMP + 10, ROWS)), strict=True):
        plant.frame[first:end].to_csv(path, index=False)
    return of_record(plant, rw.read_record(parts, plant.process))


def arrays(plant: Plant) -> Any:
    signals = {name: plant.frame[name].to_numpy() for name in plant.frame.columns[1:]}
    return of_record(plant, rw.Record(plant.frame["time_min"].to_numpy(), signals, plant.process))


def exported(plant: Plant) -> Any:
    recorded = plant.recording()
    export_csv(recorded, plant.folder / "again.csv", choice=ProcessChoice(str(plant.process)))
    return backtest_command(plant, plant.folder / "again.csv")


def written(plant: Plant) -> Any:
    write_table(plant.folder / "again.parquet", rw.read_record(plant.table, plant.process))
    return backtest_command(plant, plant.folder / "again.parquet")


def rows_by_hand(plant: Plant) -> Any:
    monitor, changes = rw.Monitor(plant.process, **plant.settings), []
    for row in plant.frame.to_dict("records"):
        time_min = row.pop("time_min")
        changes += monitor.update(time_min, row)
    return ROWS, [(item.alarm, item.time_min) for item in changes if item.event == "raised"]


def replayed(plant: Plant, file: Path) -> Any:
    _, tape = open_tape(ReplayConfig(file=str(file), plant="rig", process=str(plant.process)))
    return of_messages(plant, tape())


PATHS: dict[str, Callable[[Plant], Any]] = {
    "file": lambda plant: backtest_command(plant, plant.table),
    "record": lambda plant: of_record(plant, rw.read_record(plant.table, plant.process)),
    "two files": two_files,
    "data frame": lambda plant: of_record(plant, rw.read_record(plant.frame, plant.process)),
    "arrays": arrays,
    "rows": rows_by_hand,
    "recording": lambda plant: backtest_command(plant, plant.recording()),
    "record of a recording": lambda plant: of_record(plant, rw.read_record(plant.recording(), plant.process)),
    "exported": exported,
    "written again": written,
    "replayed table": lambda plant: replayed(plant, plant.table),
    "replayed recording": lambda plant: replayed(plant, plant.recording()),
}


@pytest.mark.parametrize("path", PATHS)
def test_a_jump_out_of_the_bounds_raises_the_range_alarm_and_its_rows_count(plant: Plant, path: str) -> None:
    rows, alarms = PATHS[path](plant)
    assert rows == ROWS
    times = [minutes for alarm, minutes in alarms if alarm == f"range/{plant.signal}"]
    assert times == pytest.approx([JUMP / 6.0], abs=1e-6)


def test_two_runs_of_a_record_are_checked_each(plant: Plant) -> None:
    second = plant.table.with_name("second.csv")
    header, *lines = plant.table.read_text(encoding="utf-8").splitlines()
    assert all("." in line.rsplit(",", 1)[1] for line in lines)
    second.write_text(
        "\n".join([header, *(f"{line}1" for line in lines)]), encoding="utf-8"
    )  # the same would be copies
    rows, alarms = of_record(plant, rw.read_record([plant.table, second], plant.process))
    assert rows == 2 * ROWS
    assert [alarm for alarm, _ in alarms].count(f"range/{plant.signal}") >= 1


def test_values_out_of_the_bounds_are_no_measurements_to_anything_but_the_check_of_the_range(tmp_path: Path) -> None:
    time_min = np.arange(6.0)
    process = rw.Process(
        "rig", (rw.Signal("y", "mm", bounds=(0.0, 100.0)), rw.Signal("sp", "mm", "setpoint", bounds=(0, 9)))
    )
    values = {"y": [1.0, -999.0, np.nan, np.inf, 100.0, 101.0], "sp": [1, 2, 3, 4, 5, 99]}
    record = rw.Record(time_min, values, process)
    assert np.isnan(record.signals["y"]).tolist() == [False, True, True, True, False, True]
    assert record.raw_columns["y"] == pytest.approx([1.0, -999.0, np.nan, np.nan, 100.0, 101.0], nan_ok=True)
    assert np.isnan(record.raw_columns["sp"]).tolist() == [False] * 5 + [True], "a set point has no check of its range"
    assert [run.raw_columns["y"][-1] for run in replace(record, runs=np.array([1, 1, 1, 2, 2, 2])).split_runs()][
        1
    ] == 101.0


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"bounds": {"leve": (0.0, 1.0)}}, r"unknown signal 'leve'"),
        ({"bounds": {"level": (9.0, 1.0)}}, r"bounds of level must be a lower and a higher number, got 9 and 1"),
        ({"resolution": {"level": -1.0}}, r"resolution of level must be in \(0, 1e6\), got -1"),
    ],
)
def test_bounds_that_cannot_be_are_one_line(settings: dict[str, Any], text: str) -> None:
    record = rw.Record(np.arange(200.0), {"level": np.arange(200.0) % 7}, rw.Process("rig", (rw.Signal("level"),)))
    with pytest.raises(rw.InputError, match=text):
        rw.backtest(record, **settings)
