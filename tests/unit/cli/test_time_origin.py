"""Every output gives the minutes of the file, wherever these begin."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from monitor_node.config import MonitorConfig
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.api.files import open_messages, record
from reactorwatch.api.simulation import simulate_along
from reactorwatch.cli.backtest import BacktestOptions, run_job
from reactorwatch.cli.batch import make_jobs
from reactorwatch.cli.diagnose import write_extended_model
from reactorwatch.cli.options import parse_span_ns
from reactorwatch.cli.recordings import cut
from reactorwatch.description.read import ProcessChoice
from reactorwatch.diagnosis.diagnose import diagnose
from reactorwatch.process.library.cstr import cstr
from reactorwatch.records.record import Record
from reactorwatch.records.write import write_table
from recorder.columns import read_run
from recorder.tools.convert import import_csv, read_record
from recorder.tools.inspect import inspect
from tests.unit.process.effect_named import effect_of

ROWS, ONSET_MIN = 600, 40.0
ORIGINS = [-ONSET_MIN, -59.9, -1.0, -5000.0, 250.0]
"""Time 0 is the event, the end, within the training, long after the end, and before the beginning."""


@pytest.fixture(scope="module")
def leaking() -> Record:
    """Minutes from 0; a leak sets in."""
    return simulate_record(PlantConfig(seed=3, faults=(f"coolant_flow:step:-0.15@{ONSET_MIN}min",)), ROWS)


def written(folder: Path, leaking: Record, origin_min: float) -> tuple[Path, Path]:
    """The record with its time beginning elsewhere, as CSV and as a recording."""
    csv, mcap = folder / "run.csv", folder / "run.mcap"
    times = np.round(leaking.time_min + origin_min, 6)
    write_table(csv, replace(leaking, time_min=times))
    import_csv(csv, mcap, "cstr")
    return csv, mcap


def watched(path: Path, model: Path | None = None) -> dict[str, Any]:
    settings = MonitorConfig(
        training_min=20.0, isolation=False, diagnose_training=False, process=None if model is None else str(model)
    )
    (job,) = make_jobs([path], BacktestOptions(settings=settings, as_json=True), elsewhere=False)
    said: dict[str, Any] = msgspec.json.decode(run_job(job).text)
    return said


@pytest.fixture(scope="module")
def expected(leaking: Record, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Back-test of the record as it is."""
    return watched(written(tmp_path_factory.mktemp("0"), leaking, 0.0)[0])


@pytest.mark.parametrize("origin_min", ORIGINS)
def test_a_back_test_gives_the_same_alarms_at_the_minutes_of_the_file(
    leaking: Record, expected: dict[str, Any], tmp_path: Path, origin_min: float
) -> None:
    """Of a CSV, and of the recording that it is imported into."""
    assert len(expected["alarms"]) >= 4
    for path in written(tmp_path, leaking, origin_min):
        found = watched(path)
        assert found["zero"] is None
        assert found["span_min"] == expected["span_min"]
        assert found["trained_until_min"] == pytest.approx(expected["trained_until_min"] + origin_min, abs=1e-9)
        assert [item["alarm"] for item in found["alarms"]] == [item["alarm"] for item in expected["alarms"]]
        minutes = [item["raised_min"] - origin_min for item in found["alarms"]]
        assert minutes == pytest.approx([item["raised_min"] for item in expected["alarms"]], abs=1e-9)


def test_a_model_with_a_deviation_at_a_minute_of_the_file_has_it_there(leaking: Record, tmp_path: Path) -> None:
    """The plant leaks as the model says, so nothing is wrong."""
    csv, mcap = written(tmp_path, leaking, -ONSET_MIN)
    model = tmp_path / "leaking.json"
    write_extended_model(
        model,
        {"format": "reactorwatch.model.v1", "model": "cstr", "effects": ["coolant_flow:step:-0.15@0min"]},
    )
    for path in (csv, mcap):
        assert watched(path, model)["alarms"] == []
        measured = record(path)
        simulated = simulate_along(measured, ProcessChoice(str(model)).load(measured.zero_ns).require_model(), [])
        assert np.sqrt(np.mean((simulated.columns["T"] - measured.columns["T"]) ** 2)) < 0.5


@pytest.mark.parametrize("origin_min", [-ONSET_MIN, -5000.0])
def test_a_diagnosis_gives_the_onset_in_the_minutes_of_the_file(
    leaking: Record, tmp_path: Path, origin_min: float
) -> None:
    for path in written(tmp_path, leaking, origin_min):
        found = diagnose(record(path), cstr(), [effect_of("coolant_flow")])
        assert found.causes[0].parameters["onset"].value == pytest.approx(ONSET_MIN + origin_min, abs=0.1)


def test_a_drawing_and_a_look_count_the_minutes_of_the_file(leaking: Record, tmp_path: Path) -> None:
    for path in written(tmp_path, leaking, -ONSET_MIN):
        recording = open_messages(path)
        shown = read_run(recording.messages)
        assert recording.zero_ns is not None
        assert (shown.span_ns[0] - recording.zero_ns) / 60e9 == -ONSET_MIN
    seen = inspect(path)
    (span,) = seen.overview.runs["cstr"]
    assert (span.first_ns - seen.zero_ns) / 60e9 == -ONSET_MIN


def test_a_cut_begins_and_ends_at_minutes_of_the_file(leaking: Record, tmp_path: Path) -> None:
    _, mcap = written(tmp_path, leaking, -ONSET_MIN)
    cut(mcap, tmp_path / "cut.mcap", begin="-10min", end="5min")
    assert read_record(tmp_path / "cut.mcap").time_min[[0, -1]].tolist() == [-10.0, 5.0]
    cut(mcap, tmp_path / "cut.mcap", end="-5min")
    assert read_record(tmp_path / "cut.mcap").time_min[[0, -1]].tolist() == [-ONSET_MIN, -5.0]
    assert watched(mcap)["alarms"]
    assert parse_span_ns("-1.5h", "--from") == -5400 * 10**9
