"""False alarms are as many as promised, with noise that has a memory; `make promise` has more runs."""

import pytest

from benchmarks.false_alarms import SPAN_MIN, count_false_alarms

RUNS, PER_30_DAYS, TRAINING_MIN = 16, 1000.0, 100.0


@pytest.mark.slow
def test_in_runs_with_autocorrelated_noise_alarms_come_as_often_as_promised() -> None:
    """The standard error of their number is a tenth of it, so a factor of 1.5 is five of these."""
    found = count_false_alarms(range(RUNS), PER_30_DAYS, diagnose_training=False)
    assert found.promised == pytest.approx(RUNS * (SPAN_MIN - TRAINING_MIN) / (30 * 24 * 60) * PER_30_DAYS, rel=0.01)
    assert 1 / 1.5 < found.ratio < 1.5, found.raised
