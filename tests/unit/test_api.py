"""The public names: few, documented, lazy, with the results that the commands print."""

import inspect
import itertools
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import reactorwatch as rw
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.api.diagnosis import DiagnosisResult
from reactorwatch.records.record import Record

LEAK_MIN = 40.0


@pytest.fixture(scope="module")
def leaking() -> Record:
    fault = f"coolant_flow:step:-0.05@{LEAK_MIN:g}min"
    scenario = {"kind": "random-steps"}
    return simulate_record(PlantConfig(duration_min=90.0, seed=7, faults=(fault,), scenario=scenario))


def test_the_public_names_are_documented_and_no_more() -> None:
    assert len(rw.__all__) == 21
    assert set(dir(rw)) == {*rw.__all__, "__version__"}
    for name in rw.__all__:
        assert inspect.getdoc(getattr(rw, name)) or name == "processes"


def test_importing_the_package_imports_none_of_its_parts() -> None:
    program = "import sys, reactorwatch; print([name for name in sys.modules if name.startswith('reactorwatch.')])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_another_name_is_no_attribute() -> None:
    with pytest.raises(AttributeError, match="no attribute 'pipeline'"):
        rw.pipeline  # noqa: B018 # the access is what is tested


@pytest.fixture(scope="module")
def found(leaking: Record) -> DiagnosisResult:
    return rw.diagnose(leaking)


def test_a_diagnosis_names_the_leak_and_its_extended_model_simulates_it(
    leaking: Record, found: DiagnosisResult, tmp_path: Path
) -> None:
    assert (found.verdict, found.causes[0].cause) == ("named", "coolant_flow")
    before = np.sqrt(np.mean((rw.simulate(leaking).columns["T"] - leaking.columns["T"]) ** 2))
    after = np.sqrt(np.mean((rw.simulate(leaking, found.extended).columns["T"] - leaking.columns["T"]) ** 2))
    assert after < 0.5 * before
    assert json.loads(json.dumps(found.to_dict()))["verdict"] == "named"
    found.to_html(tmp_path / "report.html")
    assert "coolant" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_monitor_that_is_restored_in_an_incident_gives_the_same_changes() -> None:
    """Alarms of a small leak join its incident between the looks for its cause."""
    scenario, fault = {"kind": "random-steps"}, f"coolant_flow:step:-0.01@{LEAK_MIN:g}min"
    leaking = simulate_record(PlantConfig(duration_min=90.0, seed=1, faults=(fault,), scenario=scenario))
    monitor, changes = rw.Monitor(training_min=20.0, diagnose_training=False), list[Any]()
    restored: rw.Monitor | None = None
    for row, minute in enumerate(leaking.time_min):
        values = {name: float(column[row]) for name, column in leaking.columns.items()}
        found = monitor.update(float(minute), values)
        if restored is not None:
            assert restored.update(float(minute), values) == found
        changes += found
        if any(item.event == "suspected" for item in found):
            restored = rw.Monitor(training_min=20.0, diagnose_training=False)
            restored.from_bytes(monitor.to_bytes())
    suspected = [item.suspect for item in changes if item.event == "suspected"]
    assert len(suspected) > 1
    assert all(before != after for before, after in itertools.pairwise(suspected))


def test_the_model_that_a_diagnosis_extended_judges_without_alarm(leaking: Record, found: DiagnosisResult) -> None:
    assert not rw.backtest(leaking, found.extended, training_min=20.0, diagnose_training=False).alarms


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda record: rw.simulate(record, "reactor"),
            r"unknown process 'reactor'.*valid: cstr",
        ),
        (lambda record: rw.backtest(record, charts=("no such",)), r"settings \[monitor\]: .*no such"),
        (lambda record: rw.backtest(record, forgetting=1.2), r"forgetting must be in"),
        (lambda record: rw.backtest(record, colour="red"), r"colour"),
        (lambda record: rw.identify(record, output="p"), r"holds no signal 'p', only qc, C, T"),
        (lambda _: rw.Monitor().from_bytes(b"\xc1"), r"the state of a monitor cannot be read"),
        (lambda _: rw.read_record("data.doc"), r"must be a \.csv or \.mcap file"),
    ],
)
def test_a_mistake_is_one_line_that_names_the_cure(call: object, message: str, leaking: Record) -> None:
    assert callable(call)
    with pytest.raises(rw.InputError, match=message) as caught:
        call(leaking)
    assert not re.search(r"\n", str(caught.value))
