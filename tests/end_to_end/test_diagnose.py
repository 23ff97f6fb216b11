"""`diagnose` on the command line, and the use of its extended model afterwards."""

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.diagnosis.result import Diagnosis
from reactorwatch.process.fault import parse_fault
from reactorwatch.process.library.cstr import cstr
from reactorwatch.records.record import Record
from reactorwatch.records.write import write_table
from tests.tables import read_csv

from .conftest import Command

FAULT = "coolant_flow:step:-0.08@80.03min"
ROWS = 1500


@pytest.fixture(scope="module")
def record() -> Record:
    return simulate_record(PlantConfig(seed=5, faults=(FAULT,)), ROWS)


@pytest.fixture(scope="module")
def known(record: Record) -> Diagnosis:
    return diagnose(record, cstr())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, record: Record) -> Path:
    """Where the record lies, and later its report."""
    folder = tmp_path_factory.mktemp("diagnose")
    write_table(folder / "leak.csv", record)
    return folder


@pytest.fixture(scope="module")
def diagnosis_run(folder: Path) -> subprocess.CompletedProcess[str]:
    from .conftest import REACTORWATCH

    arguments = ["diagnose", "leak.csv", "--json", "-o", "report", "--tolerance", "C=0.001,T=0.2"]
    return subprocess.run([REACTORWATCH, *arguments], capture_output=True, text=True, check=False, cwd=folder)


def test_machines_get_one_object_and_a_report(diagnosis_run: subprocess.CompletedProcess[str], folder: Path) -> None:
    assert diagnosis_run.returncode == 0, diagnosis_run.stderr
    (line,) = diagnosis_run.stdout.splitlines()
    found = json.loads(line)
    assert found["file"] == "leak.csv"
    assert found["samples"] == ROWS
    assert found["verdict"] == "named"
    assert found["seconds"] > 0
    (cause,) = found["causes"]
    assert (cause["cause"], cause["profile"]) == ("coolant_flow", "step")
    size = cause["parameters"]["size"]
    assert abs(size["value"] + 0.08) < 4 * size["sd"]
    assert {path.name for path in (folder / "report").iterdir()} == {
        "report.html", "report.json", "report.rrd", "extended.json",
    }  # fmt: skip
    report = json.loads((folder / "report" / "report.json").read_text())
    assert set(report.pop("differences")) == {"C", "T"}
    assert report == found
    assert json.loads((folder / "report" / "extended.json").read_text()) == found["extended_model"]
    page = (folder / "report" / "report.html").read_text()
    assert "coolant leak" in page
    assert not re.search(r"https?:", page)


def test_simulate_with_the_extended_model_is_the_free_run_of_the_diagnosis(
    diagnosis_run: subprocess.CompletedProcess[str], folder: Path, known: Diagnosis, called: Command
) -> None:
    assert diagnosis_run.returncode == 0
    done = called("simulate", "leak.csv", "-o", "free.csv", "--model", "report/extended.json", cwd=folder)
    assert done.returncode == 0, done.stderr
    simulated = read_csv(folder / "free.csv").columns
    assert known.curves is not None
    # the diagnosis lets its filter find the start, the command takes the first row's: the reactor forgets it in minutes
    settled = slice(300, None)
    for name, close in (("C", 5e-4), ("T", 0.05)):
        np.testing.assert_allclose(simulated[name][settled], known.curves.simulated_after[name][settled], atol=close)
        assert np.max(np.abs(known.curves.simulated_before[name] - simulated[name])[settled]) > 20 * close


def test_the_same_record_against_the_extended_model_is_nominal(
    diagnosis_run: subprocess.CompletedProcess[str], folder: Path, called: Command
) -> None:
    assert diagnosis_run.returncode == 0
    done = called("diagnose", "leak.csv", "--model", "report/extended.json", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "The simulation is right" in done.stdout


def test_the_monitor_takes_the_extended_model_for_its_reference(
    diagnosis_run: subprocess.CompletedProcess[str], folder: Path, called: Command
) -> None:
    assert diagnosis_run.returncode == 0
    settings = "[monitor]\ntraining_min = 60.0\nisolation = false\n"
    (folder / "nominal.toml").write_text(settings)
    (folder / "settings.toml").write_text(f'{settings}model = "report/extended.json"\n')
    without = json.loads(called("backtest", "leak.csv", "--config", "nominal.toml", "--json", cwd=folder).stdout)
    done = called("backtest", "leak.csv", "--config", "settings.toml", "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert without["alarms"]
    assert json.loads(done.stdout)["alarms"] == []


def test_a_plant_of_the_extended_model_has_the_fault_in_it(
    diagnosis_run: subprocess.CompletedProcess[str], folder: Path
) -> None:
    assert diagnosis_run.returncode == 0
    model = str(folder / "report" / "extended.json")
    (text,) = json.loads((folder / "report" / "extended.json").read_text())["effects"]
    fault = "feed_temperature:step:2@10min"
    for faults in ((), (fault,)):
        of_model = simulate_record(PlantConfig(seed=7, process=model, faults=faults), 1000)
        of_faults = simulate_record(PlantConfig(seed=7, faults=(text, *faults)), 1000)
        for name, values in of_model.columns.items():
            assert np.array_equal(values, of_faults.columns[name])
    assert parse_fault(text).effect.name == "coolant_flow"


def test_several_files_give_one_line_each_in_their_order_and_a_bad_one_stops_none_of_the_rest(
    folder: Path, called: Command
) -> None:
    write_table(folder / "quiet.csv", simulate_record(PlantConfig(seed=6), 300))
    (folder / "again").mkdir()
    write_table(folder / "again" / "quiet.csv", simulate_record(PlantConfig(seed=8), 300))
    (folder / "short.csv").write_text("time_min,qc,C,T\n0,100,0.1,440\n0.1,100,0.1,440\n")
    files = ["short.csv", "quiet.csv", "nowhere.csv", "again/quiet.csv"]
    done = called("diagnose", *files, "--json", "--jobs", "1", "-o", "all", cwd=folder)
    assert done.returncode == 2
    short, *found = [json.loads(line) for line in done.stdout.splitlines()]
    assert (short["file"], short["watched"]) == ("short.csv", False)
    assert "needs at least 200 rows, got 2" in short["why"]
    assert [item["file"] for item in found] == ["quiet.csv", "again/quiet.csv"]
    assert {item["verdict"] for item in found} == {"nominal"}
    assert [item["location"] for item in found] == [None, None]
    assert done.stderr.splitlines() == [
        "reactorwatch: short.csv: a diagnosis needs at least 200 rows, got 2; record for longer",
        "reactorwatch: nowhere.csv: there is no such file",
    ]
    assert sorted(path.name for path in (folder / "all").iterdir()) == [
        "quiet",
        "quiet-2",
        "summary.csv",
        "summary.json",
    ]
    rows = json.loads((folder / "all" / "summary.json").read_text())
    assert (rows["files"], rows["failed"], rows["not_watched"]) == (4, 1, 1)
    assert [row["verdict"] for row in rows["results"]] == [None, "nominal", None, "nominal"]
    assert rows["results"][2]["error"] == "there is no such file"


def test_the_proposed_experiment_is_a_file_that_drives_a_plant(tmp_path: Path, called: Command) -> None:
    narrow = PlantConfig(
        seed=2,
        faults=("heat_loss:constant:0.02",),
        scenario={"kind": "random-steps", "low": 102.41, "high": 104.41},
    )
    write_table(tmp_path / "narrow.csv", simulate_record(narrow, 1200))
    limits = ["--limits", "qc=97..110,T=425..455"]
    done = called("diagnose", "narrow.csv", "--json", "-o", "report", *limits, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    listed = [item["causes"] for item in found["alternatives"]]
    said = found["experiment"]
    assert len(listed) >= 1
    for cause in (item for causes in listed for item in causes):
        assert cause["parameters"].keys() == {"size"} | ({"onset"} if cause["profile"] == "step" else set())
        assert cause["parameters"]["size"]["sd"] > 0.0
    assert set(said["separates"]) == {item["cause"] for causes in [found["causes"], *listed] for item in causes}
    assert said["limits"]["qc"] == [97.0, 110.0]
    assert all(97.0 <= level <= 110.0 for _, level in said["input"])
    rows = round(said["span_min"] / 0.1)
    driven = simulate_record(PlantConfig(scenario=str(tmp_path / "report" / "experiment.csv")), rows)
    times, levels = np.array(said["input"]).T
    expected = levels[np.searchsorted(times, driven.time_min + 1e-6, side="right") - 1]
    np.testing.assert_array_equal(driven.columns["qc"], expected)

    write_table(tmp_path / "right.csv", simulate_record(PlantConfig(seed=6), 600))
    again = called("diagnose", "right.csv", "-o", "report", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert not (tmp_path / "report" / "experiment.csv").exists()  # that of the earlier report


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ("qc=85..x", "--limits must be signal=lowest..highest, such as qc=85..115,T=425..455, got 'qc=85..x'"),
        ("qc=85", "--limits must be signal=lowest..highest, such as qc=85..115,T=425..455, got 'qc=85'"),
        ("p=1..2", "limits must be of qc, C, T, got p"),
        ("T=455..425", "limits of T must be two rising numbers, got 455..425"),
        ("qc=85..900", "limits of qc must be within 0..500 l/min, got 85..900"),
    ],
)
def test_impossible_limits_are_reported_in_one_line(folder: Path, called: Command, limits: str, said: str) -> None:
    done = called("diagnose", "leak.csv", "-o", "nothing", "--limits", limits, cwd=folder)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", f"reactorwatch: {said}\n")
    assert not (folder / "nothing").exists()


def test_the_drawing_has_both_models_on_one_timeline(
    diagnosis_run: subprocess.CompletedProcess[str], folder: Path, known: Diagnosis
) -> None:
    from rerun.chunk import RrdReader

    assert diagnosis_run.returncode == 0
    assert known.curves is not None
    drawn: dict[str, list[float]] = {}
    for chunk in RrdReader(str(folder / "report" / "report.rrd")).stream().to_chunks():
        table = chunk.to_record_batch()
        for name in table.schema.names:
            if name.endswith("Scalars:scalars"):
                values = [value for row in table.column(name).to_pylist() if row is not None for value in row]
                drawn.setdefault(str(chunk.entity_path), []).extend(values)
    for expected in (known.curves.measured["T"], known.curves.simulated_before["T"], known.curves.simulated_after["T"]):
        assert any(
            len(values) == ROWS and np.allclose(values, expected, atol=1e-9, equal_nan=True)
            for values in drawn.values()
        )
