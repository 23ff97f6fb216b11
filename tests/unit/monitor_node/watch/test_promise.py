"""The promise is stated twice, checked by the training itself, and compared with the alarms that come.

False alarms are as many as promised, with noise that has a memory; `make faults` has more runs.
"""

from collections import Counter
from typing import Any

import numpy as np
import pytest

import reactorwatch as rw
from benchmarks.harness.bank import PERIOD_MIN, TRAINING_MIN, fault_free
from benchmarks.harness.plants import messages_of
from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.replay import backtest
from monitor_node.watch.promise import (
    PlantPromise,
    excess_by_events,
)
from reactorwatch.contract.messages_pb2 import Promise
from reactorwatch.records.record import Record

from ..samples import leaking_run
from ..watching import Watched, sound_run, watched

QUICK = MonitorConfig(isolation=False, diagnose_training=False, training_min=60.0)
ROWS_IN_30_DAYS = 432_000.0


def promises(run: Watched) -> list[Promise]:
    return [item.message for item in run.published if isinstance(item.message, Promise)]


def wandering(growth: float = 2.5, seed: int = 4) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """A run whose noise grows by a factor in the middle of a training of 60 minutes; ten later the coolant leaks."""
    time_min, columns = leaking_run(0.3, 70.0, 90.0, seed)
    noisy = time_min >= 30.0
    generator = np.random.default_rng(seed)
    for name, sd in (("C", 0.002), ("T", 0.3)):
        extra = generator.normal(size=time_min.size) * sd * np.sqrt(growth**2 - 1.0)
        columns[name] = columns[name] + np.where(noisy, extra, 0.0)
    return time_min, columns


@pytest.fixture(scope="module")
def sound() -> Watched:
    return watched(*sound_run(80.0, seed=3), QUICK)


@pytest.fixture(scope="module")
def restless() -> Watched:
    return watched(*wandering(), QUICK)


def test_the_promise_is_published_when_the_training_ends_and_with_each_snapshot(sound: Watched) -> None:
    published = promises(sound)
    assert [round(item.time_ns / 60e9) for item in published] == [60, 61, 66, 71, 76]
    assert {item.key for item in sound.published if isinstance(item.message, Promise)} == {
        "reactor/cstr/promise/monitor"
    }
    assert published[0].expected == pytest.approx(1.0)
    assert 1.0 < published[0].expected_90 < 10.0
    assert published[-1].expected_so_far == pytest.approx(published[-1].rows / ROWS_IN_30_DAYS)


def test_a_sound_plant_keeps_its_promise(sound: Watched) -> None:
    last = promises(sound)[-1]
    assert (last.kept, last.drifted, last.found, last.checked_rows) == (True, False, 0, 300)
    assert last.can_keep_per_30_days == last.expected
    assert last.expected_in_training == pytest.approx(300 / ROWS_IN_30_DAYS)


def test_a_training_that_does_not_bear_the_promise_out_reports_it_and_the_rate_that_can_be_promised(
    restless: Watched,
) -> None:
    first = promises(restless)[0]
    assert not first.kept
    assert first.can_keep_per_30_days > 10.0 * first.expected
    assert "can be promised; train longer" in first.text
    assert any(note.startswith("promise: in the second half of its training") for note in restless.monitor.notes)


def test_an_alarm_of_such_a_plant_states_the_rate_of_false_alarms(restless: Watched) -> None:
    raised = [item for item in restless.alarms if item.event == "raised"]
    sound_one = watched(*leaking_run(0.2, 70.0, 80.0, seed=3), QUICK)
    assert raised
    assert all("by its training, false alarms of this plant may come 1 in " in item.text for item in raised)
    assert not any("by its training" in item.text for item in sound_one.alarms)


def test_alarms_are_counted_beside_those_promised() -> None:
    run = watched(*leaking_run(0.2, 70.0, 90.0, seed=3), QUICK)
    last = promises(run)[-1]
    chance = ("shewhart", "ewma", "mewma", "level", "spike", "stuck")
    assert last.found == sum(name.split("/")[0] in chance for name, _ in run.raised) > 0
    assert "since, 0.0" in last.text


def test_a_plant_that_resumes_from_its_state_has_the_same_promise(restless: Watched) -> None:
    resumed = Monitor(QUICK, 0)
    resumed.from_bytes(restless.monitor.to_bytes())
    assert resumed.promise == restless.monitor.promise
    assert resumed.promise is not None
    assert not resumed.promise.kept


def test_more_events_than_chance_explains_mean_that_the_plant_has_drifted() -> None:
    promise = PlantPromise(1.0, 2.0, ROWS_IN_30_DAYS)
    for row in (100, 110, 1000):
        promise.count_alarms(2, row)
    assert (promise.found, promise.events, promise.has_drifted(1100)) == (6, 2, False)
    promise.count_alarms(1, 2000)
    assert promise.has_drifted(2100)
    assert "has drifted from its training" in promise.text(2100)
    assert not promise.has_drifted(int(2 * ROWS_IN_30_DAYS))  # four are promised until then


@pytest.mark.parametrize("factor", [1.0, 1.2, 2.0])
def test_the_excess_at_the_promised_limits_follows_from_a_common_factor_of_the_residuals(factor: float) -> None:
    """Limits too tight by a factor: run lengths A are A^(1 / factor^2), and events Poisson counts of that."""
    rng, found = np.random.default_rng(0), []
    for _ in range(200):
        events = [int(rng.poisson(5e4 / a ** (1.0 / factor**2))) for a in (1e6, 15_000.0)]
        found.append(excess_by_events(events, [1e6, 15_000.0], [5e4, 5e4]))
    assert np.median(found) == pytest.approx(1e6 ** (1.0 - 1.0 / factor**2), rel=0.5)


@pytest.fixture(scope="module")
def turned() -> Record:
    """Two outputs of white noise whose correlation changes its sign in the middle of a training of 1,000 rows."""
    rows, rng = 1500, np.random.default_rng(0)
    first, other = rng.standard_normal((2, rows))
    sign = np.where(np.arange(rows) < 500, 1.0, -1.0)
    second = 0.95 * sign * first + np.sqrt(1.0 - 0.95**2) * other
    return Record(0.1 * np.arange(rows, dtype=np.float64), {"a": first, "b": second}, "turned")


ALONE: dict[str, Any] = {"inputs": (), "outputs": ("a", "b"), "charts": ("shewhart", "ewma", "mewma")}


def test_a_chart_that_breaks_the_promise_in_the_training_is_left_out_and_its_share_goes_to_the_others(
    turned: Record,
) -> None:
    """Each output alone is as before; only a chart of both sees the change, and would raise alarm after alarm."""
    found = rw.backtest(turned, **ALONE, training_rows=1000, false_alarms_per_30_days=30.0)
    assert found.notes == [
        "training: mewma is left out: in the second half of the training it broke the promise; the others have its "
        "false alarms"
    ]
    assert found.promise is not None
    assert found.promise["kept"]
    assert found.expected_false_alarms == pytest.approx(30.0 * 500 / ROWS_IN_30_DAYS, rel=0.01)
    assert "no alarms came" in found.promise["text"]


def test_a_stored_state_without_a_chart_that_was_left_out_resumes_bit_for_bit(turned: Record) -> None:
    config = MonitorConfig(
        **ALONE, training_rows=1000, isolation=False, process="", smallest_sd={}, priorities={},
        false_alarms_per_30_days=30.0,
    )  # fmt: skip
    messages = messages_of(turned)
    monitor, again = Monitor(config, 0, points=False), Monitor(config, 0, points=False)
    for message in messages[:2600]:
        monitor.on_message(message, 0)
    again.from_bytes(monitor.to_bytes())
    assert list(again.pipeline.evaluation.charts.memory.charts) == ["shewhart", "ewma"]
    for message in messages[2600:]:
        monitor.on_message(message, 0)
        again.on_message(message, 0)
    assert again.to_bytes() == monitor.to_bytes()


def test_a_back_test_has_the_promise_for_the_rows_it_judged() -> None:
    time_min, columns = sound_run(80.0, seed=3)
    found = rw.backtest(Record(time_min, columns, "sound"), training_min=60.0, isolation=False, diagnose_training=False)
    assert found.promise is not None
    assert found.promise.expected == found.expected_false_alarms
    assert found.promise.expected < found.promise.expected_90 < 0.01
    stated = found.to_dict()["promise"]
    assert {"checked_rows", "found_in_training", "expected_in_training", "kept", "can_keep_per_30_days"} < stated.keys()
    assert stated["text"] == found.promise["text"]
    assert f"promise: {found.promise.text}" in str(found)


def test_before_rows_are_judged_there_is_no_promise() -> None:
    time_min, columns = sound_run(50.0, seed=3)
    found = rw.backtest(Record(time_min, columns, "short"), training_min=60.0, diagnose_training=False)
    assert (found.promise, found.power) == (None, [])


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
