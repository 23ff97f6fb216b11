"""The monitor over a record: intervals of its alarms, and its suspects."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf

from benchmarks.faults.bank import TRAINING_MIN, TWINS
from benchmarks.faults.score import Interval
from monitor_node.config import MonitorConfig
from monitor_node.replay import backtest
from reactorwatch.contract.codec import encode
from reactorwatch.contract.messages_pb2 import Alarm
from reactorwatch.records.record import Record, to_minutes
from recorder.tools.player import samples_of

LIKELY = 0.1
"""Suspects of at least this probability are among those that an operator would look at."""


@dataclass(frozen=True)
class Watched:
    """Output of the monitor for a record.

    Attributes:
        messages: every change of an alarm, in order.
        watching_since_min: time of the first evaluated row; inf if there was none.
        last_min: time of the last row.
    """

    messages: list[Alarm]
    watching_since_min: float
    last_min: float


@dataclass(frozen=True)
class Suspicion:
    """Ranks of the true cause among the suspects.

    Attributes:
        first: the true cause was the likeliest suspect.
        likely: the true cause was among the suspects of at least `LIKELY`.
        twin_first: a twin of it was the likeliest.
    """

    first: bool = False
    likely: bool = False
    twin_first: bool = False


def watch(record: Record, false_alarms_per_30_days: float) -> Watched:
    """Run the monitor over a record.

    Args:
        record: rows as the plant publishes them.
        false_alarms_per_30_days: promised false alarms.
    """
    config = MonitorConfig(training_min=TRAINING_MIN, false_alarms_per_30_days=false_alarms_per_30_days)
    result = backtest.run([encode(item) for item in samples_of(record, config.plant)], config)
    since = result.watching_since_ns
    return Watched(
        messages=result.alarm_messages,
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


def suspicion(messages: Sequence[Alarm], cause: str, detected_min: float, until_min: float) -> Suspicion:
    """Suspicion of the monitor at a time.

    The newest message of the incident with suspects counts: the operator sees it then.

    Args:
        messages: every change of an alarm, in order.
        cause: the true cause.
        detected_min: time when the detecting alarm was raised; inf if there was none.
        until_min: the time in minutes.
    """
    detecting = [item for item in messages if item.event == "raised" and to_minutes(item.raised_ns) == detected_min]
    if not detecting:
        return Suspicion()
    with_suspects = [
        item
        for item in messages
        if item.incident == detecting[0].incident and item.suspects and to_minutes(item.time_ns) <= until_min
    ]
    if not with_suspects:
        return Suspicion()
    suspects = sorted(with_suspects[-1].suspects, key=lambda item: -item.probability)
    return Suspicion(
        first=suspects[0].cause == cause,
        likely=any(item.cause == cause and item.probability >= LIKELY for item in suspects),
        twin_first=suspects[0].cause in TWINS.get(cause, frozenset()),
    )
