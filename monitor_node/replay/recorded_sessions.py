"""What a recording tells of the monitors that watched while it was made. Pure.

A monitor's life is from its start to its end; its reports of health tell one from another, because each says when it
was made and how long the monitor had been up. They also tell which sample of each signal was the first that it heard.
A monitor that goes on from a stored state goes on with the life of the one that stored it, and tells the same first
samples.

Two things made a monitor say something that are no samples, and both can be read off what it then said: what a person
did to an alarm is in the message of that alarm, with the time of the newest row; and a silence of the plant that the
clock of receipt told has the time at which the row after a certain one was overdue, so it is known after which.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from monitor_node.alarms.states import Event
from monitor_node.signal_checks.timeout import Silence
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.messages_pb2 import Alarm, Health
from reactorwatch.errors import InputError

MONITOR = "monitor"
SILENCE = keys.chart_name(Silence.name, "plant")

PEOPLE = frozenset(
    {"comment", *(event.value for event in Event if event not in (Event.RAISED, Event.CLEARED, Event.SHELF_TIME_OVER))}
)
"""What people do to alarms."""

SAME_START_S = 0.01
"""Starts that are as near as this are one; a report's time and up-time are rounded."""


@dataclass
class Life:
    """One life of a monitor.

    Attributes:
        starts_s: when it began, and when it went on after a stop, in seconds since 1970-01-01 UTC.
        first: number of the first message of the recording that may be its.
        end: number of the first message that may be the next one's; None: there is none.
        fresh: whether it had heard nothing yet when it first reported.
        heard_from_ns: by signal, the time of the first sample that it heard; empty: not told.
        lost: samples that it has not heard, by its own account.
        told: what people did to its alarms, and silences of the plant, in order.
    """

    starts_s: list[float]
    first: int
    end: int | None = None
    fresh: bool = False
    heard_from_ns: dict[str, int] = field(default_factory=dict)
    lost: int = 0
    told: deque[Alarm] = field(default_factory=deque)


def lives_in(messages: Iterable[Encoded], plant: str) -> list[Life]:
    """The monitors' lives that a recording tells of, in order.

    Args:
        messages: in order of receipt, without what a file says again.
        plant: whose monitors.

    Raises:
        InputError: no monitor reports, or two do at the same time.
    """
    health_key, alarms = keys.key(plant, keys.HEALTH, MONITOR), keys.key(plant, keys.ALARM, "")
    lives: list[Life] = []
    before: deque[Alarm] = deque()  # of a monitor that has not reported yet
    for number, message in enumerate(messages):
        if message.key != health_key and not message.key.startswith(alarms):
            continue
        try:
            body: Any = decode(message.payload, message.encoding)
        except DecodeError:
            continue
        if isinstance(body, Health):
            _report(lives, body, number)
        elif isinstance(body, Alarm) and _is_of_monitor(body) and (body.event in PEOPLE or is_silence(body)):
            (lives[-1].told if lives else before).append(body)
    if not lives:
        raise InputError(f"holds no report of health of a monitor of plant {plant!r}, so there is nothing to verify")
    lives[0].first = 0
    lives[0].told = before + lives[0].told
    return lives


def _is_of_monitor(alarm: Alarm) -> bool:
    """Whether it is the monitor's, and not the recorder's own."""
    return not alarm.alarm.startswith(f"{keys.RECORDING}/")


def is_silence(alarm: Alarm) -> bool:
    """Whether an alarm says that the plant has fallen silent."""
    return alarm.alarm == SILENCE and alarm.event == Event.RAISED


def _report(lives: list[Life], health: Health, number: int) -> None:
    start_s = health.time_ns / 1e9 - health.uptime_s
    known = [life for life in lives if any(abs(item - start_s) <= SAME_START_S for item in life.starts_s)]
    if not known and lives and _goes_on(lives[-1], health):
        lives[-1].starts_s.append(start_s)
    elif not known:
        if lives:
            lives[-1].end = number
        lives.append(Life([start_s], number, fresh=health.phase == "waiting"))
    elif known[0] is not lives[-1]:
        raise InputError("holds the reports of two monitors of the plant at the same time; verify takes one")
    lives[-1].heard_from_ns.update(health.heard_from_ns)
    lives[-1].lost = health.lost


def _goes_on(life: Life, health: Health) -> bool:
    """Whether the first report of a start tells that a life goes on.

    Who begins anew reports first that it waits. A life that was too short for a second report has told no first sample.
    """
    told = dict(health.heard_from_ns)
    return health.phase != "waiting" and (told == life.heard_from_ns or (life.fresh and not life.heard_from_ns))
