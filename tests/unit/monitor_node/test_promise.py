"""What is promised of false alarms is what comes: 80 long runs without a fault, with noise that has a memory."""

from collections import Counter

import numpy as np
import pytest
from scipy.signal import lfilter

from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from reactorwatch.process.library.cstr.model import cstr
from reactorwatch.process.simulate import Simulator

from .samples import samples

RUNS, SPAN_MIN, PER_30_DAYS = 80, 500.0, 200.0


def test_in_80_runs_with_autocorrelated_noise_alarms_come_as_often_as_promised() -> None:
    """Both sensors' noise is an autoregression with the coefficient 0.5; each run is trained for itself.

    148 alarms are expected. They come nearly independently, so their number has a standard error of a tenth of it; more
    than a factor of 1.5 is five of these.
    """
    simulator, counts, expected = Simulator(cstr()), Counter[str](), 0.0
    config = MonitorConfig(false_alarms_per_30_days=PER_30_DAYS, isolation=False)
    rows = round(10 * SPAN_MIN)
    time_min = np.arange(rows) / 10
    for seed in range(RUNS):
        generator = np.random.default_rng(seed)
        qc = np.repeat(generator.uniform(90, 111, rows // 10), 10)
        outputs = simulator.run(time_min, qc, np.array([0.1, 438.54])).outputs
        white = generator.normal(size=(rows + 100, 2)) * np.sqrt(1 - 0.5**2) * (0.002, 0.3)
        outputs = outputs + lfilter([1.0], [1.0, -0.5], white, axis=0)[100:]
        result = backtest.run(samples(time_min, {"qc": qc, "C": outputs[:, 0], "T": outputs[:, 1]}), config)
        counts.update(alarm.alarm for alarm, _ in result.raised_alarms)
        expected += result.expected_false_alarms
    assert expected == pytest.approx(RUNS * 400.0 / (30 * 24 * 60) * PER_30_DAYS, rel=0.01)
    assert 1 / 1.5 < counts.total() / expected < 1.5, counts
