"""What is read from the monitor's messages: when alarms stood, and whom it suspected."""

from math import inf

import pytest

from benchmarks.faults.score import Interval
from benchmarks.faults.watch import Suspicion, incidents_of, intervals_of, suspicion
from reactorwatch.contract.messages_pb2 import Alarm, Suspect
from reactorwatch.records.record import to_time_ns


def alarm(event: str, minute: float, name: str = "ewma/T", incident: int = 1, **suspects: float) -> Alarm:
    return Alarm(
        time_ns=to_time_ns(minute),
        alarm=name,
        raised_ns=to_time_ns(minute) if event == "raised" else 0,
        cleared_ns=to_time_ns(minute) if event == "cleared" else 0,
        event=event,
        incident=incident,
        suspects=[Suspect(cause=cause, probability=probability) for cause, probability in suspects.items()],
    )


def test_an_alarm_stands_from_raised_to_cleared_whatever_is_said_between() -> None:
    messages = [
        alarm("raised", 301.0),
        alarm("raised", 302.0, "ewma/C"),
        alarm("suspected", 303.0, coolant_flow=0.9),
        alarm("cleared", 304.0),
        alarm("raised", 305.0),
        alarm("raised", 306.0, "mewma/all"),
        alarm("cleared", 307.0, "mewma/all"),
    ]
    expected = {Interval(301.0, 304.0), Interval(302.0, inf), Interval(305.0, inf), Interval(306.0, 307.0)}
    assert set(intervals_of(messages)) == expected


def test_alarms_of_one_incident_are_counted_once() -> None:
    messages = [alarm("raised", 1.0), alarm("raised", 2.0, "ewma/C"), alarm("raised", 200.0, incident=2)]
    assert incidents_of(messages) == 2


@pytest.mark.parametrize(
    ("until_min", "expected"),
    [
        (302.0, Suspicion()),
        (310.0, Suspicion(first=False, likely=True, twin_first=True)),
        (400.0, Suspicion(first=True, likely=True, twin_first=False)),
    ],
)
def test_what_counts_is_the_newest_word_on_the_incident(until_min: float, expected: Suspicion) -> None:
    messages = [
        alarm("raised", 301.0, incident=2),
        alarm("suspected", 303.0, incident=2, heat_loss=0.85, coolant_flow=0.15),
        alarm("suspected", 350.0, incident=2, heat_loss=0.05, coolant_flow=0.95),
        alarm("cleared", 360.0, incident=2),
        alarm("suspected", 370.0, incident=3, temperature_bias=1.0),
    ]
    assert suspicion(messages, "coolant_flow", detected_min=301.0, until_min=until_min) == expected


def test_a_suspect_of_little_probability_is_not_among_the_likely() -> None:
    messages = [alarm("raised", 301.0), alarm("suspected", 303.0, temperature_bias=0.92, coolant_flow=0.08)]
    assert suspicion(messages, "coolant_flow", 301.0, 400.0) == Suspicion()


def test_without_a_detection_nobody_is_suspected() -> None:
    messages = [alarm("raised", 200.0, coolant_flow=1.0)]
    assert suspicion(messages, "coolant_flow", detected_min=inf, until_min=450.0) == Suspicion()
