"""Intervals of alarms and suspects, read from the monitor's messages."""

from math import inf

import pytest

from benchmarks.faults.score import Interval
from benchmarks.faults.watch import Suspicion, Watched, incidents_of, intervals_of, suspicion
from reactorwatch.contract.messages_pb2 import Alarm, Incident, Suspect
from reactorwatch.records.record import to_time_ns


def alarm(event: str, minute: float, name: str = "ewma/T", incident: int = 1) -> Alarm:
    return Alarm(
        time_ns=to_time_ns(minute),
        alarm=name,
        raised_ns=to_time_ns(minute) if event == "raised" else 0,
        cleared_ns=to_time_ns(minute) if event == "cleared" else 0,
        event=event,
        incident=incident,
    )


def suspected(minute: float, incident: int = 1, **suspects: float) -> Incident:
    named = [Suspect(cause=cause, probability=probability) for cause, probability in suspects.items()]
    return Incident(time_ns=to_time_ns(minute), number=incident, suspects=named)


def watched(alarms: list[Alarm], *incidents: Incident) -> Watched:
    return Watched(alarms, list(incidents), 0.0, 450.0)


def test_an_alarm_is_active_from_raised_to_cleared_whatever_is_published_between() -> None:
    messages = [
        alarm("raised", 301.0),
        alarm("raised", 302.0, "ewma/C"),
        alarm("acknowledge", 303.0),
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
    messages = watched(
        [alarm("raised", 301.0, incident=2), alarm("cleared", 360.0, incident=2)],
        suspected(303.0, 2, heat_loss=0.85, coolant_flow=0.15),
        suspected(350.0, 2, heat_loss=0.05, coolant_flow=0.95),
        suspected(370.0, 3, temperature_bias=1.0),
    )
    assert suspicion(messages, "coolant_flow", detected_min=301.0, until_min=until_min) == expected


def test_a_suspect_of_little_probability_is_not_among_the_likely() -> None:
    messages = watched([alarm("raised", 301.0)], suspected(303.0, temperature_bias=0.92, coolant_flow=0.08))
    assert suspicion(messages, "coolant_flow", 301.0, 400.0) == Suspicion()


def test_without_a_detection_there_is_no_suspect() -> None:
    messages = watched([alarm("raised", 200.0)], suspected(200.0, coolant_flow=1.0))
    assert suspicion(messages, "coolant_flow", detected_min=inf, until_min=450.0) == Suspicion()
