"""Outliers at the rate of the training are no alarm; a change of their rate is."""

from copy import deepcopy

import numpy as np
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.arrays import Array
from reactorwatch.spc.spike import SpikeRate, spike_count_limit

from ..samples import samples

ROWS, PERIOD_NS = 1000, 6 * 10**9
ARL0 = 3e5
CONFIG = MonitorConfig(training_min=60.0, isolation=False, diagnose_training=False)


def alarm_times(rate: float, rows: int, rng: np.random.Generator, usual: SpikeRate) -> list[int]:
    """Rows of the alarms of a sensor with outliers at a rate."""
    return [row for row in np.flatnonzero(rng.uniform(size=rows) < rate).tolist() if usual.add(row * PERIOD_NS)]


def test_a_sensor_without_outliers_has_an_alarm_at_the_first() -> None:
    assert spike_count_limit(0, ROWS, 500, ARL0) == 1
    assert SpikeRate.learn(0, ROWS, PERIOD_NS, ARL0).add(5) == 1


@pytest.mark.parametrize("rate", [0.001, 0.005, 0.02])
def test_a_steady_rate_raises_no_more_alarms_than_promised(rate: float) -> None:
    """300 sensors with a training each, over 6,000 rows: at most 6 alarms are expected."""
    rng, alarms, trained = np.random.default_rng(3), 0, 0
    while trained < 300:
        outliers = int(rng.binomial(ROWS, rate))
        if outliers:
            trained += 1
            alarms += len(alarm_times(rate, 6000, rng, SpikeRate.learn(outliers, ROWS, PERIOD_NS, ARL0)))
    assert alarms <= 12


def test_a_tenfold_rate_is_an_alarm_within_some_hundred_rows() -> None:
    rng, rows = np.random.default_rng(4), []
    for _ in range(50):
        found = alarm_times(0.05, 2000, rng, SpikeRate.learn(5, ROWS, PERIOD_NS, ARL0))
        rows.append(found[0])
    assert np.median(rows) < 400


def test_the_state_has_the_spikes_of_the_window() -> None:
    rate = SpikeRate.learn(3, ROWS, PERIOD_NS, ARL0)
    for row in range(0, 40, 10):
        assert not rate.add(row * PERIOD_NS)
    other, later = deepcopy(rate), [(50 + row) * PERIOD_NS for row in range(20)]
    assert [other.add(time) for time in later] == [rate.add(time) for time in later]


def outlying(columns: dict[str, Array], share: float, since: int, seed: int) -> dict[str, Array]:
    """Columns with outliers of 8 to 16 standard deviations of the sensor in a share of the rows from one on."""
    rng = np.random.default_rng(seed)
    changed = {name: column.copy() for name, column in columns.items()}
    for name, sd in (("C", 0.002), ("T", 0.3)):
        rows = np.flatnonzero(rng.uniform(size=changed[name].size) < share)
        rows = rows[rows >= since]
        changed[name][rows] += sd * rng.uniform(8.0, 16.0, rows.size) * rng.choice([-1.0, 1.0], rows.size)
    return changed


def count_spike_alarms(share: float, more: float = 0.0) -> int:
    """Number of spike alarms of a plant with outliers, and with more of them after the training."""
    record = simulate_record(PlantConfig(seed=6), 3000)
    columns = outlying(outlying(dict(record.columns), share, 0, 1), more, 1000, 2)
    found = backtest.run(list(samples(record.time_min, columns)), CONFIG)
    return sum(alarm.alarm.startswith("spike/") for alarm, _ in found.raised_alarms)


def test_a_plant_with_a_steady_share_of_outliers_raises_no_spike_alarm() -> None:
    assert count_spike_alarms(0.01) == 0


def test_more_outliers_than_in_the_training_raise_alarms() -> None:
    assert count_spike_alarms(0.01, more=0.08) >= 1
    assert count_spike_alarms(0.0, more=0.005) >= 3
