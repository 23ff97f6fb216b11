"""A plant, its monitor and a diagnosis after the alarm, on a bus within the process."""

import json
from pathlib import Path

import pytest
import structlog

from diagnosis_node.__main__ import DiagnosisRunner
from diagnosis_node.trigger import DiagnosisConfig, DiagnosisTrigger
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Encoded, encode
from reactorwatch.process.extended_model import parse_extended_model
from reactorwatch.records.record import Record
from recorder.tools.player import samples_of
from tests.memory_bus import Exchange, MemoryBus

ZERO_NS = 1_780_000_000 * 10**9


def watched(record: Record, out: Path, kind: type[DiagnosisRunner] = DiagnosisRunner) -> DiagnosisRunner:
    """Plays a record onto a bus that a monitor and a diagnosis hear; each diagnosis ends before the next sample."""
    exchange = Exchange()
    bus = MemoryBus(exchange)
    monitor = Monitor(MonitorConfig(training_min=60.0), 0)
    config = DiagnosisConfig(out=str(out), window_min=100.0, after_min=25.0, tolerance={"T": 0.2, "C": 0.001})
    diagnoses = kind(config)
    node = DiagnosisTrigger(config, diagnoses.start, lambda: diagnoses.busy)
    samples, alarms = (keys.all_keys("cstr", kind) for kind in (keys.SAMPLE, keys.ALARM))

    def watch(item: Encoded) -> None:
        for said in monitor.on_message(item, 0):
            bus.publish(encode(said))

    def forward(item: Encoded) -> None:
        node.on_message(item, 0)

    bus.subscribe(samples, watch)
    bus.subscribe(samples, forward)
    bus.subscribe(alarms, forward)
    for publication in samples_of(record, "cstr", ZERO_NS):
        bus.publish(encode(publication))
        diagnoses.wait()
    return diagnoses


@pytest.fixture(scope="module")
def leaking() -> Record:
    return simulate_record(PlantConfig(seed=3, faults=("coolant_flow:step:-0.1@120min",)), 1600)


def test_after_an_alarm_there_is_a_report_that_names_the_leak(leaking: Record, tmp_path: Path) -> None:
    out = tmp_path / "reports"
    with structlog.testing.capture_logs() as logs:
        watched(leaking, out)
    (folder,) = out.iterdir()
    assert folder.name.startswith("cstr-2026")
    assert {path.name for path in folder.iterdir()} == {
        "record.mcap", "report.html", "report.json", "report.rrd", "extended.json",
    }  # fmt: skip
    found = json.loads((folder / "report.json").read_text())
    (cause,) = found["causes"]
    assert (found["verdict"], cause["cause"], cause["profile"]) == ("named", "coolant_flow", "step")
    assert abs(cause["parameters"]["size"]["value"] + 0.1) < 4 * cause["parameters"]["size"]["sd"]
    # the extended model is on the plant's own clock, so that a monitor can take it
    (effect,) = parse_extended_model((folder / "extended.json").read_text()).rebase(ZERO_NS).effects
    assert effect.values["onset"] == pytest.approx(120.0, abs=0.3)
    (said,) = [item for item in logs if item["event"] == "diagnosed"]
    assert said["verdict"] == "named"
    assert said["causes"].startswith("coolant leak (coolant_flow, step) -0.1")
    assert said["report"] == str(folder / "report.html")


def test_a_diagnosis_that_fails_is_reported_and_the_next_one_is_done(leaking: Record, tmp_path: Path) -> None:
    class Failing(DiagnosisRunner):
        def execute(self, arguments: list[str]) -> tuple[int, str, str]:
            return 2, "", "warning: something\nreactorwatch: record.mcap: T must vary\n"

    with structlog.testing.capture_logs() as logs:
        diagnoses = watched(leaking, tmp_path / "reports", Failing)
    (said,) = [item for item in logs if item["event"] == "not diagnosed"]
    assert said["log_level"] == "warning"
    assert said["why"] == "reactorwatch: record.mcap: T must vary"
    assert not diagnoses.busy


def test_a_folder_that_cannot_be_made_is_reported(leaking: Record, tmp_path: Path) -> None:
    (tmp_path / "reports").write_text("a file")
    with structlog.testing.capture_logs() as logs:
        watched(leaking, tmp_path / "reports")
    (said,) = [item for item in logs if item["event"] == "not diagnosed"]
    assert "the folder cannot be made" in said["why"]


def test_a_second_report_of_the_same_moment_does_not_overwrite_the_first(leaking: Record, tmp_path: Path) -> None:
    class Nothing(DiagnosisRunner):
        def execute(self, arguments: list[str]) -> tuple[int, str, str]:
            return 2, "", "nothing"

    short = Record(leaking.time_min[:1500], {k: v[:1500] for k, v in leaking.columns.items()}, "short")
    for _ in range(2):
        watched(short, tmp_path / "reports", Nothing)
    names = sorted(path.name for path in (tmp_path / "reports").iterdir())
    assert len(names) == 2
    assert names[1] == f"{names[0]}-2"
