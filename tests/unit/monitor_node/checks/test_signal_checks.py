"""A stuck sensor, a spike and a dead plant are reported as such, at once, and as nothing else.

Outliers at the rate of the training are no alarm; a change of their rate is.
"""

from copy import deepcopy
from typing import Any

import numpy as np
import pytest

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.checks.base import CheckRow, CheckTraining
from monitor_node.checks.signal_checks import SignalChecks
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.replay import backtest
from monitor_node.watch.row_step import types_of
from monitor_node.watched_process import ANY
from plant_node.config import PlantConfig
from plant_node.record import simulate_record
from reactorwatch.arrays import Array
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.spc.spike import SpikeRate, spike_count_limit
from reactorwatch.stored_state import Memory, copy_of

from ..samples import leaking_run, samples
from ..watching import minute_ns, sound_run, watched

AT_MIN, AT = 130.0, 1300
CONFIG = MonitorConfig(isolation=False)


@pytest.mark.parametrize(("signal", "row"), [("T", AT), ("C", AT)])
def test_a_stuck_sensor_is_reported_within_ten_readings(signal: str, row: int) -> None:
    time_min, columns = sound_run(135.0, seed=1)
    columns[signal][row:] = columns[signal][row]
    run = watched(time_min, columns)
    ((minute, alarm),) = [(at, alarm) for alarm, at in run.raised if alarm.startswith("stuck")]
    assert alarm == f"stuck/{signal}"
    assert AT_MIN < minute <= AT_MIN + 1.0
    told = next(item for item in run.alarms if item.alarm == alarm)
    assert [(item.cause, item.probability) for item in told.suspects] == [("stuck_sensor", 1.0)]
    assert told.text.startswith(f"{signal} is stuck: it has read ")


@pytest.mark.parametrize(("signal", "size"), [("T", 6.0), ("T", -40.0), ("C", 0.05)])
def test_a_spike_is_reported_one_row_later_and_raises_nothing_else(signal: str, size: float) -> None:
    time_min, columns = sound_run(150.0, seed=2)
    columns[signal][AT] += size
    run = watched(time_min, columns)
    assert run.raised == [(f"spike/{signal}", AT_MIN + 0.1)]
    assert f"{size:+.1g}"[0] in run.alarms[0].text


def test_a_real_jump_of_a_sensor_is_no_spike_and_no_row_more_than_one_is_lost() -> None:
    time_min, columns = sound_run(150.0, seed=2)
    columns["T"][AT:] += 6.0
    run = watched(time_min, columns)
    assert not [alarm for alarm, _ in run.raised if alarm.startswith("spike")]
    assert run.raised[0][1] <= AT_MIN + 0.2


@pytest.mark.parametrize(("signal", "size"), [("T", 1.5), ("C", 0.01), ("leak", -0.02), ("leak", -0.05)])
def test_values_that_a_standing_fault_has_moved_are_no_spikes(signal: str, size: float) -> None:
    """A small step, and two hours with it: in each record some values are far from those before it."""
    for seed in (1, 2):
        time_min, columns = leaking_run(size if signal == "leak" else 0.0, 110.0, 240.0, seed)
        if signal != "leak":
            columns[signal][1100:] += size
        run = watched(time_min, columns)
        assert run.raised
        assert not [name for name, _ in run.raised if name.startswith("spike")]


def test_a_spike_in_a_standing_incident_belongs_to_it_and_begins_none() -> None:
    """Ninety minutes after the last change; the spike raises its own alarm."""
    time_min, columns = leaking_run(-0.05, 110.0, 240.0, 4)
    columns["T"][2000] += 30.0
    run = watched(time_min, columns)
    told = [item for item in run.alarms if item.event == "raised"]
    assert [item.time_ns for item in told if item.alarm == "spike/T"] == [minute_ns(200.1)]
    assert {item.incident for item in told} == {1}
    assert [item.alarm for item in told if item.first_in] == [told[0].alarm]
    assert told[0].alarm != "spike/T"


def test_a_dead_sensor_is_reported_while_the_others_continue() -> None:
    time_min, columns = sound_run(140.0, seed=3)
    columns["T"][AT:] = np.nan
    monitor = Monitor(CONFIG, 0)
    said = [
        item.message
        for message in samples(time_min, columns)
        if b"nan" not in message.payload
        for item in monitor.on_message(message, 0)
    ]
    raised = [(item.alarm, item.time_ns) for item in said if isinstance(item, Alarm) and item.event == "raised"]
    assert raised == [("silence/T", minute_ns(AT_MIN - 0.1 + 0.5))]


def test_a_dead_plant_is_reported_by_the_clock_of_receipt_while_nothing_arrives() -> None:
    """A row a second, then nothing: five seconds later the loop wakes the monitor, and it says so once."""
    time_min, columns = sound_run(10.0, seed=4)
    monitor = Monitor(CONFIG, 0)
    now_ns = 0
    for index, message in enumerate(samples(time_min, columns)):
        now_ns = 10**9 * (index // 3)
        monitor.on_message(message, now_ns)
    monitor.on_tick(now_ns)
    due_ns = now_ns
    said: list[Alarm] = []
    while not said:
        due_ns = monitor.next_tick_ns()
        assert due_ns < now_ns + 10**11
        said = [item.message for item in monitor.on_tick(due_ns) if isinstance(item.message, Alarm)]
    assert due_ns == now_ns + 5 * 10**9
    assert [(alarm.alarm, alarm.event, alarm.time_ns) for alarm in said] == [
        ("silence/plant", "raised", minute_ns(10.0 + 0.5))
    ]
    assert not [item for item in monitor.on_tick(due_ns + 10**12) if isinstance(item.message, Alarm)]


class ChecksMemory(Memory):
    signals: dict[str, Any]


def checks_of(config: MonitorConfig) -> SignalChecks:
    return SignalChecks(config, Annunciator(config), [ANY] * 3, np.zeros(1, types_of(config).numbers))


def training_of(seed: int) -> CheckTraining:
    values = np.random.default_rng(seed).normal(size=(2, 500)).tolist()
    return CheckTraining(values, values, [0, 0], 1e9, 1e5)


def test_a_training_changes_the_memory_of_each_check_and_replaces_none() -> None:
    """The stored state holds the same objects."""
    checks = checks_of(CONFIG)
    stored = checks.memory
    before = ChecksMemory(stored).to_bytes()
    checks.start(training_of(5))
    assert all(stored[name] is memory for name, memory in checks.memory.items())
    assert ChecksMemory(stored).to_bytes() != before


def test_rows_change_neither_a_memory_that_was_stored_before_nor_one_that_was_resumed_from() -> None:
    """A kept baseline has such a state, and may be restored more than once."""
    values, units = [0.1, 440.0], ["", ""]
    checks = [checks_of(CONFIG) for _ in range(2)]
    checks[0].start(training_of(5))
    kept = copy_of(ChecksMemory(checks[0].memory))
    before = kept.to_bytes()
    checks[1].resume(kept.signals, 0)
    for check in checks:
        for row in range(1, 30):
            check.update("signals", CheckRow(row * 10**9, (1.0, *values), units), [])
            check.update("outputs", CheckRow(row * 10**9, values, units), [])
            check.update("residuals", CheckRow(row * 10**9, [9.0 * (row % 3), 0.1], units, [1.0, 1.0]), [])
    after = [ChecksMemory(check.memory).to_bytes() for check in checks]
    assert after[0] == after[1] != before
    assert kept.to_bytes() == before


ROWS, PERIOD_NS = 1000, 6 * 10**9
ARL0 = 3e5
SPIKES = MonitorConfig(training_min=60.0, isolation=False, diagnose_training=False)


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
    found = backtest.run(list(samples(record.time_min, columns)), SPIKES)
    return sum(alarm.alarm.startswith("spike/") for alarm, _ in found.raised_alarms)


def test_a_plant_with_a_steady_share_of_outliers_raises_no_spike_alarm() -> None:
    assert count_spike_alarms(0.01) == 0


def test_more_outliers_than_in_the_training_raise_alarms() -> None:
    assert count_spike_alarms(0.01, more=0.08) >= 1
    assert count_spike_alarms(0.0, more=0.005) >= 3
