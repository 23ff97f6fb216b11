"""The full chain on a published measured record: replay, monitor, recorder, dashboard."""

import json
import signal
from pathlib import Path

import numpy as np
import pytest

from reactorwatch.records.write import write_table
from reactorwatch.runtime.bus_zenoh import ZenohBus
from tests.tables import read_csv

from .conftest import PATIENCE_S, Command, Start, WaitAlive

ROWS = 2500


def test_the_equations_reproduce_the_record(daisy_csv: Path, tmp_path: Path, called: Command) -> None:
    done = called("simulate", daisy_csv, "-o", tmp_path / "simulated.csv")
    assert done.returncode == 0, done.stderr
    measured, simulated = read_csv(daisy_csv), read_csv(tmp_path / "simulated.csv")
    assert np.array_equal(simulated.time_min, measured.time_min)
    assert np.array_equal(simulated.columns["qc"], measured.columns["qc"])
    rmse = {name: np.sqrt(np.mean((simulated.columns[name] - measured.columns[name]) ** 2)) for name in ("C", "T")}
    assert rmse["C"] <= 2.7e-4
    assert rmse["T"] <= 0.05


@pytest.fixture
def as_given(tmp_path: Path) -> tuple[str, Path]:
    """Option of a back-test that judges by the equations as given: a diagnosis of the training takes five seconds."""
    path = tmp_path / "as_given.toml"
    path.write_text("[monitor]\ndiagnose_training = false\n", encoding="utf-8")
    return "--config", path


@pytest.fixture(scope="module")
def first_rows(daisy_csv: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its first 250 minutes."""
    lines = daisy_csv.read_text(encoding="utf-8").splitlines(keepends=True)
    path = tmp_path_factory.mktemp("measured") / "daisy.csv"
    path.write_text("".join(lines[: 1 + ROWS]), encoding="utf-8")
    return path


@pytest.mark.slow
def test_replayed_it_is_watched_recorded_and_drawn(
    first_rows: Path,
    tmp_path: Path,
    bus: ZenohBus,
    endpoint: str,
    start: Start,
    wait_alive: WaitAlive,
    command: Command,
    called: Command,
    as_given: tuple[str, Path],
) -> None:
    recording = tmp_path / "daisy.mcap"
    recorder = start("record", "--endpoint", endpoint, "--out", recording)
    monitor = start("monitor", "--endpoint", endpoint)
    wait_alive("cstr", "recorder", "monitor")
    replayed = command("replay", first_rows, "--endpoint", endpoint, "--rate", "max")
    assert replayed.returncode == 0, replayed.stderr
    for node in (monitor, recorder):
        node.send_signal(signal.SIGTERM)
        assert node.wait(PATIENCE_S) == 0
    exported = tmp_path / "exported.csv"
    assert called("export", recording, "-o", exported).returncode == 0
    measured, back = read_csv(first_rows), read_csv(exported)
    for name, values in measured.columns.items():
        assert np.array_equal(back.columns[name], values), name
    assert np.allclose(back.time_min, measured.time_min - measured.time_min[0], atol=1e-9)

    drawing = called("dashboard", recording, "-o", tmp_path / "daisy.rrd")
    assert drawing.returncode == 0, drawing.stderr
    assert (tmp_path / "daisy.rrd").stat().st_size > 100_000

    said = {}
    for name, file, options in (("csv", first_rows, ()), ("mcap", recording, as_given)):
        done = called("backtest", file, *options, "--json")
        assert done.returncode == 0, done.stderr
        said[name] = json.loads(done.stdout)
    assert said["csv"]["samples"] == said["mcap"]["samples"] == ROWS
    for result in said.values():
        assert result["alarms"] == []  # it is a sound plant
        assert result["expected_false_alarms"] == pytest.approx((ROWS / 10 - 100) / (30 * 24 * 60), rel=0.01)


def test_a_fault_put_into_the_record_is_found_in_either_format_at_the_same_minute(
    first_rows: Path, tmp_path: Path, called: Command, as_given: tuple[str, Path]
) -> None:
    """Its thermometer reads 2 K too much from row 2000 on."""
    measured = read_csv(first_rows)
    measured.columns["T"][2000:] += 2.0
    csv, recording = tmp_path / "biased.csv", tmp_path / "biased.mcap"
    write_table(csv, measured)
    assert called("import", csv, "-o", recording).returncode == 0
    said = []
    for file in (csv, recording):
        done = called("backtest", file, *as_given, "--json")
        assert done.returncode == 0, done.stderr
        said.append(json.loads(done.stdout))
    onset = measured.time_min[2000]
    assert said[0]["alarms"]
    assert min(alarm["raised_min"] for alarm in said[0]["alarms"]) == pytest.approx(onset, abs=0.3)
    assert [alarm["alarm"] for alarm in said[0]["alarms"]] == [alarm["alarm"] for alarm in said[1]["alarms"]]
    for ours, theirs in zip(said[0]["alarms"], said[1]["alarms"], strict=True):
        assert ours["raised_min"] == pytest.approx(theirs["raised_min"], abs=1e-9)
        assert ours["suspect"] == theirs["suspect"]


def test_import_and_export_give_the_same_rows(daisy_csv: Path, tmp_path: Path, called: Command) -> None:
    recording, exported = tmp_path / "a.mcap", tmp_path / "b.csv"
    assert called("import", daisy_csv, "-o", recording).returncode == 0
    assert called("export", recording, "-o", exported).returncode == 0
    measured, back = read_csv(daisy_csv), read_csv(exported)
    for name, values in measured.columns.items():
        assert np.array_equal(back.columns[name], values)
