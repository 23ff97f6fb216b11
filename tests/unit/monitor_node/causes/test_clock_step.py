"""A step of the clock, or a long gap, during an incident leaves its cause as the rows before it showed it."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.cli.main import app
from reactorwatch.records.record import Record

ONSET_MIN, ROWS = 120.0, 1400


def suspects(record: Record, at_min: float, step_min: float, folder: Path) -> dict[str, float]:
    """Probabilities of the causes that a back-test names, if the clock steps at a time."""
    lines = [f"time_min,{','.join(record.columns)}"]
    for row in zip(record.time_min, *record.columns.values(), strict=True):
        shift = step_min if row[0] >= at_min - 1e-9 else 0.0
        lines.append(",".join(f"{value:.9g}" for value in (row[0] + shift, *row[1:])))
    (folder / "stepped.csv").write_text("\n".join(lines) + "\n")
    result = CliRunner().invoke(app, ["backtest", str(folder / "stepped.csv"), "--json"])
    assert result.exit_code == 0, result.output
    alarms = [item for item in json.loads(result.stdout)["alarms"] if item["alarm"] != "silence/plant"]
    assert alarms
    return {item["cause"]: item["probability"] for item in alarms[0]["suspect"]}


@pytest.fixture(scope="module")
def leaking() -> Record:
    """The reactor, which loses 15 % of its coolant from a minute on."""
    return simulate_record(PlantConfig(seed=3, faults=(f"coolant_flow:step:-0.15@{ONSET_MIN:g}min",)), ROWS)


@pytest.mark.parametrize("step_min", [60.0, -60.0])
@pytest.mark.parametrize(
    "after_min", [3.0, pytest.param(8.0, marks=pytest.mark.slow), pytest.param(15.0, marks=pytest.mark.slow)]
)
def test_after_a_clock_step_the_cause_is_still_named(
    leaking: Record, after_min: float, step_min: float, tmp_path: Path
) -> None:
    found = suspects(leaking, ONSET_MIN + after_min, step_min, tmp_path)
    assert max(found, key=found.__getitem__) == "coolant_flow"
    assert found["coolant_flow"] > 0.5


@pytest.mark.parametrize("step_min", [60.0, -60.0])
def test_a_clock_step_before_the_first_look_leaves_what_the_rows_show(
    leaking: Record, step_min: float, tmp_path: Path
) -> None:
    found = suspects(leaking, ONSET_MIN + 0.9, step_min, tmp_path)
    assert found.get("unknown", 0.0) < 0.5
    assert found.get("coolant_flow", 0.0) > 0.1
