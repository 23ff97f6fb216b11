"""A missing signal raises an alarm, is left out with the reason, and the others are monitored."""

import numpy as np
import pytest
from msgspec.structs import replace

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from monitor_node.replay import backtest
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.records.record import MINUTE_NS
from reactorwatch.results.backtest import Backtest

from .samples import Rows, leaking_run, sample

CONFIG = MonitorConfig(training_min=40.0, isolation=False, diagnose_training=False)
LEAK_MIN, END_MIN = 70.0, 80.0
SIGNALS = ("qc", "C", "T")
Run = tuple[Rows, dict[str, Rows]]


@pytest.fixture(scope="module")
def leak() -> Run:
    """The coolant leaks a tenth from minute 70 on."""
    return leaking_run(-0.1, LEAK_MIN, END_MIN, seed=4)


def messages(run: Run, signal: str, first: int, end: int) -> list[Encoded]:
    """The samples of a run; of one signal only those in rows from `first` up to `end`."""
    time_min, columns = run
    return [
        sample(name, row - first if name == signal else row, float(minute), float(values[row]))
        for row, minute in enumerate(time_min)
        for name, values in columns.items()
        if name != signal or first <= row < end
    ]


def watch(run: Run, signal: str, first: int = 0, end: int = 0, config: MonitorConfig = CONFIG) -> Backtest:
    return backtest.run(messages(run, signal, first, end), config)


def raised_min(result: Backtest) -> dict[str, float]:
    """Minute at which each alarm was first raised."""
    return {alarm.alarm: alarm.raised_ns / MINUTE_NS for alarm, _ in reversed(result.raised_alarms)}


@pytest.mark.parametrize("reference", ["auto", "process", "arx"])
@pytest.mark.parametrize("signal", SIGNALS)
def test_without_one_signal_its_silence_is_reported_and_the_others_are_monitored(
    signal: str, reference: str, leak: Run
) -> None:
    config = replace(CONFIG, reference=reference)
    result = watch(leak, signal, config=config)
    assert result.exclusions == {signal: "no value of it has come"}
    assert f"training: {signal} is left out: no value of it has come" in result.notes
    assert result.watching_since_ns == 40 * MINUTE_NS
    raised = raised_min(result)
    assert raised.pop(f"silence/{signal}") == pytest.approx(10.0)  # a hundred rows
    assert raised
    assert not any(name.endswith(f"/{signal}") for name in raised)
    assert min(raised.values()) > LEAK_MIN


@pytest.mark.parametrize(("signal", "last"), [("T", 0), ("T", 20), ("C", 49), ("qc", 20), ("T", 60), ("qc", 300)])
def test_a_signal_that_ends_in_the_training_ends_no_training(signal: str, last: int, leak: Run) -> None:
    """Whether the training had values enough of it or not; its silence stands in either case."""
    result = watch(leak, signal, 0, last)
    assert result.watching_since_ns == 40 * MINUTE_NS
    assert 0.1 * last < raised_min(result)[f"silence/{signal}"] < 0.1 * last + 10.1
    assert set(result.exclusions) == ({signal} if last < 50 else set())


def test_a_signal_that_arrives_after_the_training_ends_its_silence_and_is_reported_as_not_monitored(leak: Run) -> None:
    result = watch(leak, "T", 500, 801)
    ends = {alarm.alarm: cleared_ns for alarm, cleared_ns in result.raised_alarms}
    assert ends["silence/T"] == 50 * MINUTE_NS
    assert result.exclusions == {"T": "its first value came after the training"}
    assert result.notes[-1] == "T comes now, and is not watched: start the monitor without its state to learn it"


@pytest.mark.parametrize("every", [2, 10, 50, 90])
def test_a_slow_sensor_is_not_silent_from_its_first_value_on(every: int) -> None:
    """An analyser that gives one value in so many rows."""
    time_min, columns = leaking_run(0.0, 1.0, 200.0, seed=5)
    slow = [
        sample(name, row // every if name == "C" else row, float(minute), float(values[row]))
        for row, minute in enumerate(time_min)
        for name, values in columns.items()
        if name != "C" or row % every == 0
    ]
    result = backtest.run(slow, MonitorConfig(training_min=1000.0, isolation=False))
    assert result.raised_alarms == []


@pytest.mark.parametrize("signal", ["T", "qc"])
def test_a_monitor_without_a_signal_resumes_from_its_stored_state(signal: str, leak: Run) -> None:
    run = messages(leak, signal, 0, 0)
    monitor, said = Monitor(CONFIG, 0), list[Publication]()
    expected = [item for message in run for item in monitor.on_message(message, 0)]
    again = Monitor(CONFIG, 0)
    for number, message in enumerate(run):
        if number % 211 == 0:
            stored, again = again.to_bytes(), Monitor(CONFIG, 0)
            again.from_bytes(stored)
        said += again.on_message(message, 0)
    assert said == expected
    assert again.excluded_signals == monitor.excluded_signals == {signal: "no value of it has come"}
    assert again.pipeline.baselines.expected_false_alarms == monitor.pipeline.baselines.expected_false_alarms
    assert any(isinstance(item.message, Alarm) and item.message.event == "raised" for item in said)


def test_a_sound_plant_without_a_signal_keeps_the_promise() -> None:
    """The share of the signal that is left out goes to the others."""
    time_min, columns = leaking_run(0.0, 1.0, 140.0, seed=6)
    whole = backtest.run(messages((time_min, columns), "", 0, 0), CONFIG)
    result = watch((time_min, columns), "T")
    assert [alarm.alarm for alarm, _ in result.raised_alarms] == ["silence/T"]
    assert result.expected_false_alarms == pytest.approx(whole.expected_false_alarms, rel=1e-9)
    assert np.isfinite(result.expected_false_alarms)
