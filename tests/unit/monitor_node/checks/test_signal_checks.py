"""A stuck sensor, a spike and a dead plant are reported as such, at once, and as nothing else."""

from typing import Any

import numpy as np
import pytest

from monitor_node.alarms.annunciator import Annunciator
from monitor_node.checks.base import CheckRow, CheckTraining
from monitor_node.checks.signal_checks import SignalChecks
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.watch.row_step import types_of
from monitor_node.watched_process import ANY
from reactorwatch.contract.messages_pb2 import Alarm
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
