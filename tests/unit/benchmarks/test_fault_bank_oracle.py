"""The oracle's delay is that of the likelihood ratio, and its threshold keeps the promise."""

from math import inf, log

import numpy as np
import pytest
from scipy import stats

from benchmarks.faults.bank import BANK, Case
from benchmarks.faults.oracle import log_likelihood_ratio, oracle_delay_min
from benchmarks.faults.oracle_suspect import oracle_suspect
from benchmarks.faults.runs import record_of, truth_of
from reactorwatch.spc.charts.cusum import cusum_run_length

ARL0 = 432_000.0


def test_the_ratio_is_that_of_normal_densities() -> None:
    rng = np.random.default_rng(1)
    y, y0, y1 = rng.normal(size=(3, 5, 2))
    sd = np.array([0.5, 2.0])
    expected = np.sum(stats.norm.logpdf(y, y1, sd) - stats.norm.logpdf(y, y0, sd), axis=1)
    assert log_likelihood_ratio(y, y0, y1, sd) == pytest.approx(expected)


def test_rows_that_are_just_what_the_fault_gives_add_up_until_the_threshold() -> None:
    time_min = np.arange(1000) / 10
    nominal, faulty = np.zeros((1000, 1)), np.full((1000, 1), 0.6)
    # Each row adds 0.6^2 / 2 = 0.18, so ln(432,000) = 12.98 is reached with the 73rd row from the onset.
    delay_min = oracle_delay_min(time_min, log_likelihood_ratio(faulty, nominal, faulty, np.ones(1)), 20.05, ARL0)
    assert delay_min == pytest.approx(20.1 + 7.2 - 20.05)


def test_in_noise_the_mean_delay_is_that_of_walds_identity() -> None:
    rng = np.random.default_rng(2)
    time_min = np.arange(4000) / 10
    nominal, faulty = np.zeros((4000, 1)), np.full((4000, 1), 0.3)
    delays_min = [
        oracle_delay_min(
            time_min, log_likelihood_ratio(faulty + rng.normal(size=(4000, 1)), nominal, faulty, np.ones(1)), 0.0, ARL0
        )
        for _ in range(400)
    ]
    # h + overshoot = drift x rows; the overshoot of a normal walk of step 0.3 is 0.583 x 0.3 (Siegmund 1985, ch. X).
    rows = (log(ARL0) + 0.583 * 0.3) / 0.045
    # A delay's standard deviation is about sqrt(2 h) / 0.045 = 113 rows, the mean's standard error 5.7.
    assert np.mean(delays_min) * 10 + 1 == pytest.approx(rows, abs=3 * 5.7)


def test_a_fault_that_is_not_there_is_not_found() -> None:
    rows = np.zeros((100, 2))
    assert oracle_delay_min(np.arange(100.0), log_likelihood_ratio(rows, rows, rows, np.ones(2)), 10.0, ARL0) == inf


@pytest.mark.parametrize("shift", [0.25, 1.0, 3.0])
def test_pages_test_with_that_threshold_has_at_least_the_promised_run_length(shift: float) -> None:
    arl0 = 2000.0
    # In units of sigma: allowance shift / 2, limit ln(arl0) / shift; one side has twice the run length of two.
    one_sided = 2 * cusum_run_length(0.0, shift / 2, log(arl0) / shift)
    assert one_sided >= arl0


@pytest.mark.parametrize(("cause", "size"), [("temperature_bias", -0.55), ("heat_transfer", -0.25)])
def test_the_oracle_suspects_the_true_cause_of_a_fault_that_no_other_cause_imitates(cause: str, size: float) -> None:
    fault = next(item for item in BANK if item.cause == cause and item.profile == "step")
    case = Case(fault, "medium", size, 300.04, 11)
    record = record_of(case)
    assert oracle_suspect(case, record, truth_of(case, record)) == cause
