"""The monitor over a record: intervals of its alarms, and its suspects."""

from collections.abc import Iterable
from dataclasses import dataclass
from math import inf

from benchmarks.faults.bank import TRAINING_MIN, TWINS
from benchmarks.faults.score import Interval
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from reactorwatch.contract.codec import encode
from reactorwatch.contract.messages_pb2 import Alarm, Incident, Suspect
from reactorwatch.records.record import Record, to_minutes
from recorder.tools.player import samples_of

LIKELY = 0.1
"""Suspects of at least this probability are among those that an operator would look at."""


@dataclass(frozen=True)
class Watched:
    """Output of the monitor for a record."""

    messages: list[Alarm]  # every change of an alarm, in order
    incidents: list[Incident]  # every change of an incident, in order
    watching_since_min: float  # time of the first evaluated row; inf if there was none
    last_min: float  # time of the last row


@dataclass(frozen=True)
class Suspicion:
    """Ranks of the true cause among the suspects."""

    first: bool = False  # the true cause was the likeliest suspect
    likely: bool = False  # the true cause was among the suspects of at least `LIKELY`
    twin_first: bool = False  # a twin of it was the likeliest


def watch(record: Record, false_alarms_per_30_days: float) -> Watched:
    """Run the monitor over a record."""
    config = MonitorConfig(training_min=TRAINING_MIN, false_alarms_per_30_days=false_alarms_per_30_days)
    result = backtest.run([encode(item) for item in samples_of(record, config.plant)], config)
    since = result.watching_since_ns
    return Watched(
        messages=result.alarm_messages,
        incidents=result.incident_messages,
        watching_since_min=inf if since is None else to_minutes(since),
        last_min=to_minutes(result.last_ns),
    )


def intervals_of(messages: Iterable[Alarm]) -> list[Interval]:
    """Interval of each alarm, from the messages that it was raised and cleared."""
    raised: dict[str, float] = {}
    found = []
    for message in messages:
        if message.event == "raised":
            raised[message.alarm] = to_minutes(message.raised_ns)
        elif message.event == "cleared" and message.alarm in raised:
            found.append(Interval(raised.pop(message.alarm), to_minutes(message.cleared_ns)))
    return found + [Interval(minute, inf) for minute in raised.values()]


def incidents_of(messages: Iterable[Alarm]) -> int:
    """Number of incidents of the alarms."""
    return len({message.incident for message in messages if message.event == "raised"})


def newest_suspects(watched: Watched, incident: int, until_min: float = inf) -> list[Suspect]:
    """Suspects of an incident at a time in minutes, as an operator has them; empty without any."""
    own = [(item.time_ns, item.suspects) for item in watched.messages if item.names_cause and item.incident == incident]
    shared = [(item.time_ns, item.suspects) for item in watched.incidents if item.number == incident]
    found = [(at, suspects) for at, suspects in (*own, *shared) if suspects and to_minutes(at) <= until_min]
    return list(max(found, key=lambda item: item[0])[1]) if found else []


def suspicion(watched: Watched, cause: str, detected_min: float, until_min: float) -> Suspicion:
    """Suspicion of the monitor at a time.

    The newest suspects of the incident count, or those of an alarm of it that names its cause itself.
    """
    raised = (item for item in watched.messages if item.event == "raised")
    detecting = [item for item in raised if to_minutes(item.raised_ns) == detected_min]
    if not detecting:
        return Suspicion()
    newest = newest_suspects(watched, detecting[0].incident, until_min)
    if not newest:
        return Suspicion()
    suspects = sorted(newest, key=lambda item: -item.probability)
    return Suspicion(
        first=suspects[0].cause == cause,
        likely=any(item.cause == cause and item.probability >= LIKELY for item in suspects),
        twin_first=suspects[0].cause in TWINS.get(cause, frozenset()),
    )
