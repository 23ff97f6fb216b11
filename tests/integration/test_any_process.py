"""A plant of any process in the running system: monitored, recorded, verified, drawn, diagnosed and replayed."""

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from reactorwatch.api.files import open_messages, record
from reactorwatch.cli.diagnose import DiagnosisOptions, load_case
from reactorwatch.cli.replay import run as run_verification
from reactorwatch.contract import keys
from reactorwatch.contract.codec import decode
from reactorwatch.contract.messages_pb2 import Alarm, Estimate
from reactorwatch.description.read import find_process
from reactorwatch.runtime.http_pages import free_endpoint
from recorder.columns import read_segments
from recorder.files.recording import Recording
from recorder.panels import signals
from recorder.panels.base import TimePlot
from recorder.tools.convert import export_csv
from recorder.tools.inspect import inspect
from recorder.view.file import write_rrd
from tests.unit.plant_node.test_plant_of_any_process import RIG

WITHIN_S = 120.0
SETTINGS = """
[plant]
duration_min = 40.0
seed = 3
[monitor]
training_rows = 200
diagnose_training = false
"""

Up = Callable[..., Path]


def run_up(folder: Path, *arguments: str) -> Path:
    """Run `up` until it ends by itself; returns the recording."""
    (folder / "settings.toml").write_text(SETTINGS, encoding="utf-8")
    command = [sys.executable, "-m", "reactorwatch", "up", "--config", "settings.toml", "--speed", "2400"]
    done = subprocess.run(
        [*command, "--endpoint", free_endpoint(), "--out", "runs", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=WITHIN_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (recording,) = (folder / "runs").glob("*.mcap")
    return recording


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a rig with units of its own; the file that described it is no longer there."""
    folder = tmp_path_factory.mktemp("rig")
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    recording = run_up(folder, "--process", "rig.toml", "--fault", "pump1:step:-3@30min")
    (folder / "rig.toml").rename(folder / "elsewhere.toml")
    return recording


def alarms(recording: Path) -> list[Alarm]:
    found = [decode(item.payload, item.encoding) for item in Recording(recording).messages({keys.ALARM})]
    return [item for item in found if isinstance(item, Alarm)]


def test_a_described_plant_is_watched_by_its_equations(rig: Path) -> None:
    """In the units of the equations, whatever those of the samples."""
    raised = [item for item in alarms(rig) if item.event == "raised"]
    assert raised
    assert min(item.time_ns for item in raised) - inspect(rig).zero_ns >= 30 * 60e9
    found = [decode(item.payload, item.encoding) for item in Recording(rig).messages({keys.ESTIMATE})]
    judged = [item for item in found if isinstance(item, Estimate)]
    assert {item.unit for item in judged} == {"cm"}


def test_it_is_verified_with_no_option_and_without_its_file(rig: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_verification(rig, None, None, as_json=True) == 0
    assert json.loads(capsys.readouterr().out)["plant"] == "rig"


def test_it_is_drawn_by_signal_and_role_with_no_option(rig: Path, tmp_path: Path) -> None:
    source = open_messages(rig)
    (run,) = read_segments(source.messages, process=source.process)
    plots = [plot for plot in signals.draw_overview(run) if isinstance(plot, TimePlot)]
    assert [(plot.title, plot.unit) for plot in plots] == [
        ("h1: level of tank 1", "mm"),
        ("h2: level of tank 2", "cm"),
        ("h3: level of tank 3", "cm"),
        ("Q1: flow of pump 1", "l/h"),
        ("Q2: flow of pump 2", "cm3/s"),
    ]
    lines = {line.name: line.value for line in plots[0].series}
    last = [float(lines[name][-1]) for name in ("measured", "lower limit", "upper limit")]
    assert np.all(np.abs(np.array(last) - 400.0) < 40.0)  # mm
    write_rrd([run], tmp_path / "run.rrd")


def test_it_is_read_for_a_diagnosis_with_no_option(rig: Path) -> None:
    case = load_case(rig, DiagnosisOptions())
    assert case.process.require_model().parameter("a2").value == 0.62
    assert case.uncertain == {"a2": 0.01}
    assert case.record.units == case.process.require_model().units
    assert np.nanmax(case.record.columns["h1"]) < 62.0  # cm


@pytest.mark.slow
def test_it_is_played_again_as_a_table_through_the_same_nodes(
    rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    export_csv(rig, tmp_path / "rig.csv")
    again = run_up(tmp_path, "--process", "rig.toml", "--record", "rig.csv", "--plant", "north")
    assert run_verification(again, None, None, as_json=True) == 0
    capsys.readouterr()
    process = find_process(tmp_path / "rig.toml")
    played, recorded = record(again, process=process), record(rig, process=process)
    for name, values in recorded.columns.items():
        np.testing.assert_allclose(played.columns[name], values, rtol=1e-9)
    assert {item.alarm for item in alarms(again)} == {item.alarm for item in alarms(rig)}
    assert {plant: item.name for plant, item in inspect(again).processes.items()} == {"north": "rig"}
