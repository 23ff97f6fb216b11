"""False alarms are as many as promised, with noise that has a memory; `make faults` has more runs."""

from collections import Counter

import pytest

from benchmarks.harness.bank import PERIOD_MIN, TRAINING_MIN, fault_free
from benchmarks.harness.plants import messages_of
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest

RUNS, ROWS, PER_30_DAYS = 16, 5000, 1000.0


@pytest.mark.slow
def test_in_runs_with_autocorrelated_noise_alarms_come_as_often_as_promised() -> None:
    """The standard error of their number is a tenth of it, so a factor of 1.5 is five of these."""
    config = MonitorConfig(false_alarms_per_30_days=PER_30_DAYS, isolation=False, diagnose_training=False)
    results = [backtest.run(messages_of(fault_free(seed, ROWS, 0.5)), config) for seed in range(RUNS)]
    promised = sum(result.expected_false_alarms for result in results)
    raised = Counter(alarm.alarm for result in results for alarm, _ in result.raised_alarms)
    watched_min = RUNS * (ROWS * PERIOD_MIN - TRAINING_MIN)
    assert promised == pytest.approx(watched_min / (30 * 24 * 60) * PER_30_DAYS, rel=0.01)
    assert 1 / 1.5 < raised.total() / promised < 1.5, raised
