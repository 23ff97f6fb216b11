"""A case goes through all detectors, and what they did comes out as a table and as numbers."""

import io
import json

import pytest
from rich.console import Console

from benchmarks.faults.bank import BANK, Case
from benchmarks.faults.study import (
    MONITOR,
    ORACLE,
    CaseResult,
    FaultFreeResult,
    Widths,
    detectors,
    fault_free_statistics,
    run_case,
    run_fault_free,
)
from benchmarks.faults.tables import as_json, print_fault_free, print_summary, print_table

BUDGET = 30.0
WIDTHS: Widths = {"ARX": {BUDGET: 5.0}, "OE": {BUDGET: 7.6}}
ONSET_MIN = 300.04
GROSS = Case(next(item for item in BANK if item.name == "temperature_bias"), "large", 5.0, ONSET_MIN, 21)


@pytest.fixture(scope="module")
def result() -> CaseResult:
    return run_case(GROSS, (BUDGET,), WIDTHS)


@pytest.fixture(scope="module")
def quiet() -> FaultFreeResult:
    return run_fault_free(31, 0.0, 3000, (BUDGET,), WIDTHS)


def test_a_sensor_that_is_off_by_17_standard_deviations_is_seen_at_once_by_the_oracle_and_by_the_report_method(
    result: CaseResult,
) -> None:
    outcomes = result.outcomes[BUDGET]
    assert set(outcomes) == set(detectors())
    delays_min = [outcomes[name].delay_min for name in (ORACLE, "ARX equal rate", "OE 3 sigma")]
    assert delays_min == pytest.approx([0.06, 0.06, 0.06], abs=1e-6)  # the first row after the onset
    assert outcomes[MONITOR].delay_min < 1.0


def test_false_alarms_are_counted_in_the_200_minutes_between_training_and_onset(result: CaseResult) -> None:
    by_3_sigma = result.outcomes[BUDGET]["ARX 3 sigma"]
    assert by_3_sigma.watched_min == pytest.approx(ONSET_MIN - 100.0)
    # Were the residuals white and normal: 2,000 rows x 0.54 %, about 11. A linear model of this plant makes it more.
    assert 5 <= by_3_sigma.false_alarms <= 60


def test_a_wider_limit_raises_fewer_alarms_in_a_run_without_a_fault(quiet: FaultFreeResult) -> None:
    alarms = quiet.alarms[BUDGET]
    assert alarms["ARX 3 sigma"].watched_min == pytest.approx(200.0)
    assert alarms["ARX equal rate"].count < alarms["ARX 3 sigma"].count


def test_limits_are_learned_from_the_watched_rows_alone() -> None:
    assert {name: item.size for name, item in fault_free_statistics(5, rows=1200).items()} == {"ARX": 200, "OE": 200}


def test_the_table_and_the_summary_list_the_results(result: CaseResult, quiet: FaultFreeResult) -> None:
    console = Console(file=io.StringIO(), width=200)
    print_table(console, [result], BUDGET)
    print_summary(console, [result], BUDGET, WIDTHS)
    print_fault_free(console, [quiet], BUDGET)
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    (row,) = (line for line in lines if "temperature_bias" in line)
    assert [cell.strip() for cell in row.split("│")][1:4] == ["temperature_bias", "5", "100% 0.06 / 0.06"]
    assert "limits of the report's method at equal rate: ARX +- 5.00 sigma, OE +- 7.60 sigma" in lines


def test_the_numbers_behind_the_table_can_be_written(result: CaseResult, quiet: FaultFreeResult) -> None:
    told = json.loads(json.dumps(as_json([result], [quiet], [BUDGET], WIDTHS)))
    assert told["faults"][0]["delay_min"][ORACLE] == pytest.approx(0.06)
    assert told["fault_free"][0]["false_alarms"]["ARX 3 sigma"] == quiet.alarms[BUDGET]["ARX 3 sigma"].count
