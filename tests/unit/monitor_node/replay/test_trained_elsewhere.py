"""A plant that was trained on one record is judged on another from its first row."""

import numpy as np
import pytest

from monitor_node.config import MonitorConfig
from monitor_node.replay.backtest import RowLog, TrainedPlant, rows_of_file, run, train
from reactorwatch.errors import InputError
from reactorwatch.results.backtest import Backtest

from ..samples import Rows, leaking_run, samples

ONSET_MIN, SPAN_MIN = 20.0, 40.0
ARX = MonitorConfig(reference="arx", isolation=False, charts=("ewma",), false_alarms_per_30_days=30)
EQUATIONS = MonitorConfig(reference="equations", isolation=False, diagnose_training=False)


@pytest.fixture(scope="module")
def sound() -> tuple[Rows, dict[str, Rows]]:
    return leaking_run(0.0, 0.0, 120.0, 1)


@pytest.fixture(scope="module")
def leaking() -> tuple[Rows, dict[str, Rows]]:
    return leaking_run(-0.1, ONSET_MIN, SPAN_MIN, 2)


def judged(trained: TrainedPlant, config: MonitorConfig, run_of: tuple[Rows, dict[str, Rows]]) -> Backtest:
    return run(samples(*run_of), config, trained=trained)


@pytest.mark.parametrize("config", [ARX, EQUATIONS])
def test_each_row_of_another_record_is_judged_and_its_fault_found(
    config: MonitorConfig, sound: tuple[Rows, dict[str, Rows]], leaking: tuple[Rows, dict[str, Rows]]
) -> None:
    trained = train(samples(*sound), config)
    assert trained.rows == sound[0].size
    result = judged(trained, config, leaking)
    assert result.watching_since_ns == result.first_ns == 0
    assert (result.samples, result.training_rows) == (leaking[0].size, sound[0].size)
    assert result.raised_alarms
    assert all(alarm.raised_ns >= ONSET_MIN * 60e9 for alarm, _ in result.raised_alarms)
    assert not judged(trained, config, leaking_run(0.0, 0.0, SPAN_MIN, 3)).raised_alarms


def test_the_times_of_the_training_are_unrelated_to_those_of_the_judged_record(
    sound: tuple[Rows, dict[str, Rows]], leaking: tuple[Rows, dict[str, Rows]]
) -> None:
    """The same alarms in the same rows, whether the training was before, during or after the judged record."""
    raised = []
    for shift_min in (0.0, 33.3, 1e6):
        trained = train(samples(sound[0] + shift_min, sound[1]), ARX)
        result = judged(trained, ARX, leaking)
        raised.append([(alarm.alarm, alarm.raised_ns) for alarm, _ in result.raised_alarms])
    assert raised[0]
    assert raised[1] == raised[2] == raised[0]


def test_a_record_with_too_few_rows_to_learn_from_is_refused(sound: tuple[Rows, dict[str, Rows]]) -> None:
    few = {name: values[:40] for name, values in sound[1].items()}
    with pytest.raises(InputError, match=r"must have at least 73 rows .* got 40 rows"):
        train(samples(sound[0][:40], few), ARX)


def test_the_log_has_each_row_and_is_in_alarm_from_raised_to_cleared(leaking: tuple[Rows, dict[str, Rows]]) -> None:
    """Held to the intervals of the alarms themselves; rows of the training are without alarms."""
    config = MonitorConfig(training_min=15.0, isolation=False)
    time_min, columns = leaking
    columns = {name: np.where(np.arange(time_min.size) == 17, np.nan, values) for name, values in columns.items()}
    log, times_ns = RowLog(), np.round(time_min * 60e9).astype(np.int64)
    result = run(samples(time_min, columns), config, log=log)
    rows = rows_of_file(log.rows, times_ns.tolist())
    assert [row.time_ns for row in rows] == times_ns.tolist()
    intervals = [(alarm.raised_ns, cleared_ns) for alarm, cleared_ns in result.raised_alarms]
    assert intervals
    for row in rows:
        assert row.raised == any(raised_ns == row.time_ns for raised_ns, _ in intervals)
        assert row.in_alarm == any(
            raised_ns <= row.time_ns and (cleared_ns is None or row.time_ns < cleared_ns)
            for raised_ns, cleared_ns in intervals
        )
