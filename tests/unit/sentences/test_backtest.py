"""A back-test in words: the reference in use, its noise levels, and a headline for each incident."""

import re
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from monitor_node.config import MonitorConfig
from monitor_node.replay.backtest import run
from reactorwatch.contract.messages_pb2 import PRIORITY_CRITICAL, PRIORITY_HIGH, Alarm, Suspect
from reactorwatch.records.record import to_time_ns
from reactorwatch.results.alarms import RaisedAlarm
from reactorwatch.results.backtest import Backtest
from reactorwatch.sentences.backtest import backtest_headline, backtest_text
from reactorwatch.sentences.incidents import MOST_INCIDENTS, alarm_lines, headline
from tests.unit.monitor_node.samples import leaking_run, samples


def judged(reference: Literal["auto", "process", "arx"], span_min: float = 115.0) -> Backtest:
    record = samples(*leaking_run(0.0, 1.0, span_min, seed=1))
    return run(record, MonitorConfig(reference=reference, isolation=False))


@pytest.mark.parametrize("reference", ["auto", "process"])
def test_the_equations_are_named_with_the_noise_of_the_sensors_and_states(
    reference: Literal["auto", "process"],
) -> None:
    result = judged(reference)
    assert result.reference == "equations"
    assert result.noise_levels is not None
    assert result.noise_levels.sensors == {"C": pytest.approx(0.002, rel=0.2), "T": pytest.approx(0.3, rel=0.2)}
    assert set(result.noise_levels.states) == {"C", "T"}
    assert "reference: the equations; standard deviation of the sensors' noise: C 0.00" in backtest_text(result)


@pytest.mark.parametrize(
    ("span_min", "reference", "stated"), [(115.0, "arx", ["reference: identified models (ARX)"]), (20.0, None, [])]
)
def test_identified_models_and_a_record_that_was_not_judged_have_no_noise_levels(
    span_min: float, reference: str | None, stated: list[str]
) -> None:
    result = judged("arx", span_min)
    assert (result.reference, result.noise_levels) == (reference, None)
    assert [line for line in backtest_text(result).splitlines() if line.startswith("reference: ")] == stated


def test_a_note_on_the_promise_is_left_out_where_the_promise_is_stated() -> None:
    note = "promise: it does not hold"
    result = replace(judged("arx"), notes=[note, "another"])
    assert result.promise is not None
    assert "another" in backtest_text(result)
    assert note not in backtest_text(result)
    assert note in backtest_text(replace(result, promise=None))


def raised(
    alarm: str,
    minute: float,
    cleared_min: float | None,
    incident: int,
    suspect: Suspect | None = None,
    *,
    priority: int = PRIORITY_HIGH,
    text: str = "",
) -> RaisedAlarm:
    """An alarm; one of silence names its cause itself."""
    suspects = [] if suspect is None else [suspect]
    message = Alarm(
        alarm=alarm,
        priority=priority,  # type: ignore[arg-type]
        raised_ns=to_time_ns(minute),
        incident=incident,
        suspects=suspects,
        text=text,
        names_cause=alarm.startswith(("silence/", "stuck/", "range/")),
    )
    return RaisedAlarm.of(message, None if cleared_min is None else to_time_ns(cleared_min), 0)


LEAK = Suspect(
    cause="coolant_flow", probability=0.94, text="15 % of the coolant lost", profile="step", onset_ns=to_time_ns(149.99)
)
SILENCE = Suspect(cause="silence", probability=1.0, kind="sensor")
SILENT = "the plant is silent: no sample of it comes"


def test_the_headline_of_an_incident_states_its_cause_onset_and_probability() -> None:
    alarms = [raised("ewma/T", 150.3, 160.0, 1), raised("mewma/all", 151.0, None, 1, LEAK)]
    assert headline(alarms, 0) == [
        "Detected since 150 min: 15 % of the coolant lost (94 %); 2 alarms, the first ewma/T at 150.3 min"
    ]
    assert headline([], 0) == ["no alarms"]


def test_an_incident_without_a_named_cause_lists_what_deviates() -> None:
    alarm = raised("shewhart/T", 150.3, None, 1, text="T is 7 K above the model; Q1 is at its upper bound")
    assert headline([alarm], 0) == [
        "Detected since 150.3 min: T is 7 K above the model, no cause named; 1 alarm, shewhart/T at 150.3 min"
    ]


def test_the_headline_of_a_record_with_clock_time_states_it() -> None:
    """For minutes from the epoch, as in Python, and from the clock time itself, as in the command."""
    day = to_time_ns(1_000_000.0)
    for zero, at in ((0, 150.5), (day, 1_000_150.5)):
        (line,) = headline([raised("ewma/T", at, None, 1)], zero, day)
        assert line.startswith("Detected since 150.5 min (1971-11-26T13:10:30Z): ")


def test_a_silent_plant_and_a_later_fault_of_one_incident_are_not_mixed() -> None:
    alarms = [
        raised("silence/plant", 120.4, 149.0, 1, SILENCE, text=SILENT),
        raised("shewhart/T", 150.3, None, 1, LEAK),
    ]
    (line,) = headline(alarms, 0)
    assert line.startswith("Detected since 150 min: 15 % of the coolant lost (94 %); 1 alarm, shewhart/T at 150.3 min")
    assert line.endswith("; in the same incident silence/plant at 120.4 min")


SIZES = {
    "a higher priority": (("a/T", 10.0, 500.0, 1), ("b/T", 600.0, 610.0, 2), (PRIORITY_HIGH, PRIORITY_CRITICAL)),
    "a longer time in alarm": (("a/T", 10.0, 20.0, 1), ("b/T", 600.0, 640.0, 2), (PRIORITY_HIGH, PRIORITY_HIGH)),
    "one that is active at the end": (("a/T", 10.0, 900.0, 1), ("b/T", 999.0, None, 2), (PRIORITY_HIGH, PRIORITY_HIGH)),
}


@pytest.mark.parametrize(("smaller", "larger", "priorities"), SIZES.values(), ids=SIZES)
def test_the_largest_incident_comes_first(
    smaller: tuple[str, float, float | None, int],
    larger: tuple[str, float, float | None, int],
    priorities: tuple[int, int],
) -> None:
    alarms = [raised(*item, priority=priority) for item, priority in zip((smaller, larger), priorities, strict=True)]
    first, second = headline(alarms, 0)
    assert larger[0] in first
    assert smaller[0] in second


_ALARM = st.tuples(
    st.sampled_from(["shewhart/T", "ewma/C", "silence/plant", "stuck/T", "range/T"]),
    st.integers(1, 14),
    st.sampled_from([1, 2, 3, 4]),
    st.one_of(st.none(), st.floats(0.1, 50.0)),
)


@given(st.lists(_ALARM, min_size=1, max_size=30))
def test_whatever_is_raised_there_is_one_line_an_incident_and_none_states_the_alarm_of_another(
    drawn: list[tuple[str, int, int, float | None]],
) -> None:
    drawn.sort(key=lambda item: item[1])
    alarms = [
        raised(
            name,
            100.0 * incident + row,
            None if length is None else 100.0 * incident + row + length,
            incident,
            priority=priority,
        )
        for row, (name, incident, priority, length) in enumerate(drawn)
    ]
    lines, incidents = headline(alarms, 0), {item[1] for item in drawn}
    events, shown = lines[:MOST_INCIDENTS], []
    assert len(lines) == min(len(incidents), MOST_INCIDENTS) + (len(incidents) > MOST_INCIDENTS)
    for line in events:
        times = [float(time) for time in re.findall(r"(?:since|at) ([0-9.]+) min", line)]
        (incident,) = {int(time) // 100 for time in times}
        shown.append(max(priority for _, number, priority, _ in drawn if number == incident))
    assert shown == sorted(shown, reverse=True)


def test_the_promise_that_a_training_cannot_keep_is_reported_before_the_alarms_and_they_are_no_detections() -> None:
    result = judged("arx")
    assert result.promise is not None
    weak = replace(result, promise=replace(result.promise, kept=False), can_keep_per_30_days=1080.0)
    alarms = [raised("ewma/T", 150.3, 160.0, 1), raised("mewma/all", 900.0, None, 2, LEAK)]
    for shown, count in (
        (alarms, "2 alarms were raised in 2 incidents"),
        (alarms[:1], "1 alarm was raised in 1"),
        ([], "no alarms were raised"),
    ):
        lines = backtest_text(replace(weak, alarms=shown)).splitlines()
        assert lines[1].startswith(
            "not trustworthy yet: by its training, false alarms may come 1 in 40 min; train longer"
        )
        assert count in lines[1]
        assert not any("detected" in line.lower() for line in lines)
    assert lines[2].startswith("training: ")


def test_a_leak_after_a_step_of_the_clock_is_stated_since_its_own_onset() -> None:
    """The truth is the simulation's: the clock is set forward by 45 min at minute 130, the leak starts 20 min later."""
    time_min, columns = leaking_run(-0.15, 150.0, 200.0, seed=1)
    stepped = np.where(time_min > 130.0, time_min + 45.0, time_min)
    result = run(samples(stepped, columns), MonitorConfig())
    (line,) = backtest_headline(result)
    found = re.match(r"Detected since ([0-9.]+) min: 15 % of the coolant lost \([0-9]+ %\)", line)
    assert found is not None, line
    assert float(found[1]) == pytest.approx(195.0, abs=1.0)
    assert line.endswith("; in the same incident silence/plant at 130.5 min")


def test_an_alarm_that_comes_and_goes_within_an_incident_is_one_line() -> None:
    alarms = [raised("ewma/T", minute, minute + 5, 1) for minute in (100.0, 110.0, 120.0)]
    alarms.append(raised("ewma/T", 400.0, None, 2))
    assert alarm_lines(alarms, 0) == [
        "incident 1, from 100 min",
        "        100 min  ewma/T (high), raised 3 times, cleared at 125 min: ",
        "incident 2, from 400 min",
        "        400 min  ewma/T (high), active at the end: ",
    ]
