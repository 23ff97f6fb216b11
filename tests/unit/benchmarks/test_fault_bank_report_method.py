"""The report's method is what the report did, and its wider limits keep the rate that they are widened for."""

import numpy as np
import pytest
from scipy import stats

from benchmarks.faults.report_method import (
    METHODS,
    TRAINING_ROWS,
    ReportMethod,
    alarms_of,
    calibrated_width,
    count_alarms,
)
from benchmarks.faults.score import Interval
from reactorwatch.arrays import Array
from reactorwatch.records.record import Record

ARX, OE = METHODS
A, B = (1.5, -0.7, 0.1), (0.5, 0.3, 0.1)


def linear_record(rows: int, output_error: bool) -> Record:
    """Two linear outputs of order 3 with noise of standard deviation 1, that the plant feels or that it does not."""
    rng = np.random.default_rng(3)
    flows = np.repeat(rng.uniform(90, 111, rows // 10), 10)
    columns = {"qc": flows}
    for signal in ("C", "T"):
        noise, y = rng.normal(size=rows), np.zeros(rows)
        for k in range(3, rows):
            y[k] = A[0] * y[k - 1] + A[1] * y[k - 2] + A[2] * y[k - 3]
            y[k] += B[0] * flows[k - 1] + B[1] * flows[k - 2] + B[2] * flows[k - 3] + (0 if output_error else noise[k])
        columns[signal] = y + (noise if output_error else 0)
    return Record(np.arange(rows) / 10, columns, "linear")


def widest_share(statistic: Array, width: float) -> float:
    return float(np.mean(statistic[TRAINING_ROWS:] > width))


@pytest.mark.parametrize(("method", "output_error"), [(ARX, False), (OE, True)])
def test_on_a_plant_that_its_model_can_describe_3_sigma_is_left_by_chance(
    method: ReportMethod, output_error: bool
) -> None:
    statistic = method.statistic(linear_record(41_000, output_error))
    by_chance = 1 - (1 - 2 * stats.norm.sf(3.0)) ** 2  # of one of two independent normal residuals
    # Standard error of the share: 3.7e-4; and limits learned from 1,000 rows are up to 5 % too narrow or wide.
    assert widest_share(statistic, 3.0) == pytest.approx(by_chance, abs=1.5e-3)


def test_a_jump_of_one_output_is_seen_by_the_row_it_comes_in() -> None:
    record = linear_record(2000, output_error=True)
    record.columns["T"][1500:] += 20.0
    statistic = OE.statistic(record)
    assert not np.any(statistic[1400:1500] > 8.0)
    assert statistic[1500] > 15.0


def test_an_alarm_lasts_from_the_first_point_out_to_the_first_that_is_in() -> None:
    statistic = np.array([9.0, 1.0, 1.0, 4.0, 4.0, 2.0, 5.0])
    found = alarms_of(np.arange(7) / 10, statistic, 3.0)
    assert found == [Interval(0.0, 0.1), Interval(0.3, 0.5), Interval(0.6, np.inf)]
    assert count_alarms([statistic, np.zeros(5)], 3.0) == 3


def test_limits_for_independent_normal_points_are_widened_to_the_normal_quantile() -> None:
    rows = np.abs(np.random.default_rng(4).normal(size=(20, 50_000)))
    width = calibrated_width(list(rows), rows_to_false_alarm=1000.0)
    # 1,000 alarms are counted: a rate known to 3 %, which at 3.3 sigma is a width known to 1 %.
    assert width == pytest.approx(stats.norm.isf(0.5 / 1000), rel=0.02)


def test_limits_count_alarms_and_not_the_points_of_one() -> None:
    # Every hundredth row 10 points in a row are out: one alarm in 100 rows, though one point in ten is out.
    run = np.tile(np.concatenate([np.zeros(90), np.full(10, 5.0)]), 50)
    assert calibrated_width([run], rows_to_false_alarm=99.0) < 5.0
    assert calibrated_width([run], rows_to_false_alarm=101.0) == 5.0


@pytest.mark.parametrize("rows_to_false_alarm", [50.0, 500.0])
def test_at_the_widened_limits_no_more_alarms_come_than_promised(rows_to_false_alarm: float) -> None:
    shocks = np.random.default_rng(5).normal(size=(4, 5000))
    runs = [np.abs(np.convolve(item, np.ones(10), "valid")) for item in shocks]  # each resembles its neighbours
    count = count_alarms(runs, calibrated_width(runs, rows_to_false_alarm))
    allowed = sum(run.size for run in runs) / rows_to_false_alarm
    assert allowed - 1 <= count <= allowed
