"""The whole chain, as real processes on a real router: what `make demo` promises."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
from google.protobuf.message import Message

from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, decode
from reactorwatch.contract.messages_pb2 import Alarm, AlarmState, Estimate, Fault, Health, ModelSnapshot, Sample
from reactorwatch.records.record import to_time_ns
from recorder.files.recording import Recording

from .conftest import COMMAND_WITHIN_S, REACTORWATCH

B = TypeVar("B", bound=Message)
ONSET_MIN, SPAN_MIN = 150.0, 200.0


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder of a demonstration, run as fast as it goes, and what it said."""
    folder = tmp_path_factory.mktemp("demo") / "run"
    command = [REACTORWATCH, "demo", "--out", str(folder), "--speed", "max", "--duration", f"{SPAN_MIN:g}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=COMMAND_WITHIN_S, check=False)
    logs = "\n".join(path.read_text() for path in folder.glob("*.log"))
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}\n{logs}"
    return folder, done.stdout


@pytest.fixture(scope="module")
def recorded(demo: tuple[Path, str]) -> list[Encoded]:
    """Everything in its recording, in order of receipt."""
    return [Encoded(*entry[:4]) for entry in Recording(demo[0] / "demo.mcap").messages()]


def bodies(recorded: list[Encoded], kind: type[B]) -> list[B]:
    return [body for body in (decode(item.payload, item.encoding) for item in recorded) if isinstance(body, kind)]


def test_it_leaves_a_recording_a_drawing_and_a_summary(demo: tuple[Path, str]) -> None:
    folder, said = demo
    names = {path.name for path in folder.iterdir()}
    assert {"demo.mcap", "demo.rrd", "summary.md", "settings.toml"} <= names
    assert not [name for name in names if name.endswith(".part")]
    summary = (folder / "summary.md").read_text()
    assert "onset at 150.0 min" in summary
    headline = summary.splitlines()[2]
    assert re.fullmatch(r"Detected after \d+ s; cause named: coolant leak, 15 % of the coolant lost\.", headline)
    assert "Alarm raised" in summary
    assert "demo.rrd" in summary
    assert "Diagnosis of the whole recording: The simulation is wrong: coolant leak, since 1" in summary
    written = {path.name for path in (folder / "diagnosis").iterdir()}
    assert written == {"report.html", "report.json", "report.rrd", "extended.json"}
    assert summary in said


def test_nothing_is_lost_on_the_way_to_the_file(recorded: list[Encoded]) -> None:
    rows = round(SPAN_MIN * 10)
    for signal in ("qc", "C", "T"):
        key = keys.key("demo", keys.SAMPLE, signal)
        numbers = [body.sequence for body in bodies([item for item in recorded if item.key == key], Sample)]
        assert numbers == list(range(rows))
    estimates = [item for item in recorded if item.key == keys.key("demo", keys.ESTIMATE, "T")]
    assert len(estimates) == rows - 53  # fifty rows give the scaling, three more the first regressor
    assert bodies(recorded, ModelSnapshot)


def test_the_alarm_comes_after_the_fault_and_not_before(recorded: list[Encoded]) -> None:
    zero_ns = bodies(recorded, Sample)[0].time_ns
    (fault,) = bodies(recorded, Fault)
    assert fault.onset_ns == to_time_ns(ONSET_MIN, zero_ns)
    raised = [body for body in bodies(recorded, Alarm) if body.state == AlarmState.ALARM_STATE_UNACKNOWLEDGED]
    assert raised
    assert fault.onset_ns <= raised[0].time_ns <= to_time_ns(ONSET_MIN + 10, zero_ns)


def test_a_back_test_gives_the_same_alarms_value_for_value(recorded: list[Encoded]) -> None:
    again = backtest.run(recorded, MonitorConfig(plant="demo"))
    live = bodies(recorded, Alarm)
    assert live
    assert [alarm.SerializeToString() for alarm in again.alarm_messages] == [a.SerializeToString() for a in live]


def test_the_last_health_of_every_node_is_stopped(recorded: list[Encoded]) -> None:
    last = {health.node: health.phase for health in bodies(recorded, Health)}
    assert last["plant"] == last["monitor"] == "stopped"


def test_the_settings_that_ran_are_written_down_with_the_seed(demo: tuple[Path, str]) -> None:
    settings = tomllib.loads((demo[0] / "settings.toml").read_text())
    assert settings["plant"]["seed"] == 1
    assert settings["bus"]["endpoint"].startswith("tcp/127.0.0.1:")


def test_the_drawing_has_every_tab_the_diagnosis_among_them(demo: tuple[Path, str]) -> None:
    from rerun.chunk import RrdReader

    reader, tabs = RrdReader(demo[0] / "demo.rrd"), []
    for chunk in reader.stream(store=reader.blueprints()[0]).to_chunks():
        table = chunk.to_record_batch()
        if "ContainerBlueprint:display_name" in table.schema.names:
            tabs += [name[0] for name in table.column("ContainerBlueprint:display_name").to_pylist() if name]
    panels = {"Overview", "Residuals and charts", "Alarms", "Model", "Phase plane", "Promise", "Health", "Diagnosis"}
    assert sorted(tabs) == sorted(panels)


def test_rerun_accepts_the_drawing_and_its_series_are_the_samples(
    demo: tuple[Path, str], recorded: list[Encoded]
) -> None:
    from rerun.chunk import RrdReader

    drawing = demo[0] / "demo.rrd"
    rerun = str(Path(sys.executable).with_name("rerun"))
    checked = subprocess.run([rerun, "rrd", "verify", str(drawing)], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    measured: dict[str, list[float]] = {}
    for chunk in RrdReader(str(drawing)).stream().to_chunks():
        table = chunk.to_record_batch()
        for name in table.schema.names:
            if name.endswith("Scalars:scalars"):
                values = [value for row in table.column(name).to_pylist() if row is not None for value in row]
                measured.setdefault(str(chunk.entity_path), []).extend(values)
    key = keys.key("demo", keys.SAMPLE, "T")
    expected = [body.value for body in bodies([item for item in recorded if item.key == key], Sample)]
    matching = [path for path, values in measured.items() if np.array_equal(values, expected)]
    assert matching, f"no series of {list(measured)} holds the measured T"
    predictions = [
        body.prediction
        for body in bodies([item for item in recorded if item.key == keys.key("demo", keys.ESTIMATE, "T")], Estimate)
    ]
    assert any(np.array_equal(values, predictions) for values in measured.values())
