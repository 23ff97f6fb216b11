"""Commands that take a record take one of several runs, and report it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.replay.backtest import run as watch
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from plant_node.scenario import HeldRecord
from reactorwatch.api.backtest_report import backtest_object, backtest_text
from reactorwatch.api.simulation import report, simulate_along
from reactorwatch.cli import identification
from reactorwatch.contract.codec import encode
from reactorwatch.errors import InputError
from reactorwatch.identification.identify import ModelForm
from reactorwatch.process.library.cstr import cstr
from reactorwatch.records.record import Record, join_runs
from recorder.tools.player import samples_of

ROWS, FIRST = 1600, 1100


@pytest.fixture(scope="module")
def whole() -> Record:
    return simulate_record(PlantConfig(seed=3, faults=("coolant_flow:step:-0.1@130min",)), ROWS)


def cut(record: Record, back_min: float) -> Record:
    times = record.time_min - np.where(np.arange(ROWS) < FIRST, 0.0, back_min)
    return replace(record, time_min=times, runs=1 + (np.arange(ROWS) >= FIRST))


def test_each_run_is_simulated_from_its_own_first_row(whole: Record, tmp_path: Path) -> None:
    record = cut(whole, 60.05)
    simulated = simulate_along(record, cstr(), ["coolant_flow:step:-0.05@75min"])
    alone = [simulate_along(run, cstr(), ["coolant_flow:step:-0.05@75min"]) for run in record.split_runs()]
    assert np.array_equal(simulated.columns["T"], join_runs(alone).columns["T"])
    assert np.array_equal(simulated.time_min, record.time_min)
    assert simulated.runs is not None
    assert json.loads(report(record, simulated, cstr(), tmp_path, as_json=True))["runs"] == 2
    assert "2 runs" in report(record, simulated, cstr(), tmp_path, as_json=False)


def test_a_run_of_one_row_is_simulated_as_that_row(whole: Record) -> None:
    runs = 1 + (np.arange(ROWS) >= 500) + (np.arange(ROWS) >= 501)
    simulated = simulate_along(replace(whole, runs=runs), cstr(), [])
    assert simulated.rows == ROWS
    assert simulated.columns["T"][500] == whole.columns["T"][500]
    whole_run = simulate_along(whole, cstr(), [])
    assert np.array_equal(simulated.columns["T"][:500], whole_run.columns["T"][:500])


@pytest.mark.parametrize("model", ["arx", "oe", "armax"])
@pytest.mark.parametrize("row", [400])
def test_no_row_is_identified_from_rows_of_another_run(whole: Record, model: str, row: int) -> None:
    """However far the clock is set back, the model is the one of the same rows after a gap."""

    def identified(back_min: float) -> object:
        runs = 1 + (np.arange(ROWS) >= row)
        record = replace(whole, time_min=whole.time_min - back_min * (runs - 1), runs=runs)
        form = ModelForm(model, order=2)
        return json.loads(identification.fit(record, ("qc",), ("T",), form, as_json=True))

    after_a_gap = identified(-50.0)
    assert identified(60.0) == after_a_gap
    assert identified(0.05) == after_a_gap


@pytest.mark.parametrize("back_min", [0.25, 60.0, 60.05])
def test_a_back_test_raises_the_same_alarms_after_the_clock_was_set_back(whole: Record, back_min: float) -> None:
    settings = MonitorConfig(isolation=False, diagnose_training=False)
    straight, back = (
        watch((encode(item) for item in samples_of(record, "cstr")), settings)
        for record in (whole, cut(whole, back_min))
    )
    raised = [
        (alarm.alarm, round(alarm.raised_ns / 60e9 - minutes, 3))
        for result, minutes in ((straight, 0.0), (back, -back_min))
        for alarm, _ in result.raised_alarms
    ]
    assert raised[: len(raised) // 2] == raised[len(raised) // 2 :]
    assert len(raised) >= 4
    said = backtest_object(back, 0)
    assert (said["samples"], said["runs"], said["zero"]) == (ROWS, 2, None)
    assert said["span_min"] == pytest.approx(159.8)
    assert "2 runs" in backtest_text(back, 0, Path("run.csv"))


def test_several_runs_drive_no_plant(whole: Record) -> None:
    with pytest.raises(InputError, match=r"must be one run to drive the plant, .* 2 runs"):
        HeldRecord.of(cut(whole, 60.0), cstr().inputs[0])
