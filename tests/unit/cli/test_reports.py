"""`backtest` says what judged the rows and by which noise levels."""

import dataclasses
from pathlib import Path
from typing import Literal

import pytest

from monitor_node.config import MonitorConfig
from monitor_node.replay.backtest import Backtest, run
from reactorwatch.api.alarm_lines import Raised, alarm_headline, alarm_lines
from reactorwatch.api.backtest_report import backtest_object, backtest_text
from reactorwatch.contract.messages_pb2 import Alarm, Suspect
from reactorwatch.records.record import to_time_ns
from tests.unit.monitor_node.samples import leaking_run, samples


def judged(reference: Literal["auto", "process", "arx"], span_min: float = 115.0) -> Backtest:
    record = samples(*leaking_run(0.0, 1.0, span_min, seed=1))
    return run(record, MonitorConfig(reference=reference, isolation=False))


@pytest.mark.parametrize("reference", ["auto", "process"])
def test_the_equations_are_named_with_the_noise_of_the_sensors_and_states(
    reference: Literal["auto", "process"],
) -> None:
    result = judged(reference)
    found = backtest_object(result, 0)
    assert found["reference"] == "equations"
    assert found["noise_levels"]["sensors"] == {"C": pytest.approx(0.002, rel=0.2), "T": pytest.approx(0.3, rel=0.2)}
    assert set(found["noise_levels"]["states"]) == {"C", "T"}
    assert "reference: the equations; standard deviation of the sensors' noise: C 0.00" in backtest_text(
        result, 0, Path("run.csv")
    )


def test_identified_models_are_named_and_have_no_noise_levels() -> None:
    result = judged("arx")
    found = backtest_object(result, 0)
    assert (found["reference"], found["noise_levels"]) == ("arx", None)
    assert "reference: identified models (ARX)" in backtest_text(result, 0, Path("run.csv"))


def test_a_record_that_was_not_judged_names_nothing() -> None:
    result = judged("auto", 20.0)
    found = backtest_object(result, 0)
    assert (found["reference"], found["noise_levels"]) == (None, None)
    assert "reference: " not in backtest_text(result, 0, Path("run.csv"))


def test_a_note_on_the_promise_is_left_out_where_the_promise_is_stated() -> None:
    result = judged("arx")
    note = "promise: it does not hold"
    with_note = dataclasses.replace(result, notes=[note, "another"])
    assert result.promise is not None
    assert "another" in backtest_text(with_note, 0, Path("run.csv"))
    assert note not in backtest_text(with_note, 0, Path("run.csv"))
    assert note in backtest_text(dataclasses.replace(with_note, promise=None), 0, Path("run.csv"))


def raised(alarm: str, minute: float, cleared_min: float | None, incident: int, text: str = "") -> Raised:
    suspects = [Suspect(cause="coolant_flow", probability=0.94, text=text)] if text else []
    message = Alarm(alarm=alarm, priority=3, raised_ns=to_time_ns(minute), incident=incident, suspects=suspects)  # type: ignore[arg-type]
    return message, None if cleared_min is None else to_time_ns(cleared_min)


def test_the_headline_names_the_first_alarm_the_incidents_and_the_cause() -> None:
    alarms = [raised("ewma/T", 150.3, 160.0, 1), raised("mewma/all", 151.0, None, 1, "15 % of the coolant lost")]
    assert alarm_headline(alarms, 0) == (
        "Detected at 150.3 min by ewma/T: 2 alarms in 1 incident; likely cause: 15 % of the coolant lost (94 %)"
    )
    assert alarm_headline([], 0) == ""


def test_the_headline_of_a_record_with_clock_time_states_it() -> None:
    """For minutes from the epoch, as in Python, and from the clock time itself, as in the command."""
    day = to_time_ns(1_000_000.0)
    for zero, at in ((0, 150.5), (day, 1_000_150.5)):
        headline = alarm_headline([raised("ewma/T", at, None, 1)], zero, day)
        assert headline.startswith("Detected at 150.5 min (1971-11-26T13:10:30Z) by ewma/T")


def test_an_alarm_that_comes_and_goes_within_an_incident_is_one_line() -> None:
    alarms = [raised("ewma/T", minute, minute + 5, 1) for minute in (100.0, 110.0, 120.0)]
    alarms.append(raised("ewma/T", 400.0, None, 2))
    assert alarm_lines(alarms, 0) == [
        "incident 1, from 100 min",
        "        100 min  ewma/T (high), raised 3 times, cleared at 125 min: ",
        "incident 2, from 400 min",
        "        400 min  ewma/T (high), active at the end: ",
    ]
