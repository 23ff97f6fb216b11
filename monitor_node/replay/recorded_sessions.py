"""Monitor sessions in a recording.

A session is from the start of a monitor to its end. Sessions are distinguished by their health messages, which have a
time and an up-time. These also have the time of each signal's first sample. A monitor that resumes from a stored state
continues the session of the one that stored it, with the same first samples.

Two kinds of events other than samples cause alarm messages, and both can be read from these: an operator's action has
the time of the newest row; and a data timeout in receive time has the time at which the next row was overdue, which
shows after which row it was raised.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from monitor_node.alarms.states import Event
from monitor_node.signal_checks.timeout import DataTimeout
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode
from reactorwatch.contract.messages_pb2 import Alarm, Baseline, Health
from reactorwatch.errors import InputError

MONITOR = "monitor"
TIMEOUT_ALARM = keys.chart_name(DataTimeout.name, "plant")

ACTIONS = frozenset(
    {"comment", *(event.value for event in Event if event not in (Event.RAISED, Event.CLEARED, Event.SHELF_TIME_OVER))}
)
"""Events of operators' actions."""

SAME_START_S = 0.01
"""Tolerance of a start; the time and up-time of a health message are rounded."""


@dataclass
class Session:
    """Session of a monitor.

    Attributes:
        starts_s: times of the start and of restarts, in seconds since 1970-01-01 UTC.
        first: index of the first message of the recording that may belong to the session.
        end: index of the first message that may belong to the next session; None: there is none.
        fresh: True if the first health message was sent before the first sample.
        heard_from_ns: time of the first sample by signal; empty if unknown.
        lost: number of lost samples that the monitor reported.
        events: operators' actions and data timeouts, in order.
        baselines: changes of the baseline, in order.
    """

    starts_s: list[float]
    first: int
    end: int | None = None
    fresh: bool = False
    heard_from_ns: dict[str, int] = field(default_factory=dict)
    lost: int = 0
    events: deque[Alarm] = field(default_factory=deque)
    baselines: list[Baseline] = field(default_factory=list)


def find_sessions(messages: Iterable[Encoded], plant: str) -> list[Session]:
    """Find the sessions of a plant's monitors in a recording, in order.

    Args:
        messages: messages in order of receipt, without latched messages.
        plant: name of the plant.

    Raises:
        InputError: there is no health message of a monitor, or those of two monitors at the same time.
    """
    wanted = {keys.key(plant, kind, MONITOR) for kind in (keys.HEALTH, keys.BASELINE)}
    alarms = keys.key(plant, keys.ALARM, "")
    sessions: list[Session] = []
    before: deque[Alarm] = deque()  # of a monitor without a health message so far
    early: list[Baseline] = []  # of the same
    for number, message in enumerate(messages):
        if message.key not in wanted and not message.key.startswith(alarms):
            continue
        try:
            body: Any = decode(message.payload, message.encoding)
        except DecodeError:
            continue
        if isinstance(body, Health):
            _report(sessions, body, number)
        elif isinstance(body, Baseline):
            baselines = sessions[-1].baselines if sessions else early
            if body not in baselines:  # a monitor that resumes publishes it again
                baselines.append(body)
        elif isinstance(body, Alarm) and _is_from_monitor(body) and (body.event in ACTIONS or is_timeout(body)):
            (sessions[-1].events if sessions else before).append(body)
    if not sessions:
        raise InputError(f"holds no report of health of a monitor of plant {plant!r}, so there is nothing to verify")
    sessions[0].first = 0
    sessions[0].events = before + sessions[0].events
    sessions[0].baselines[:0] = [item for item in early if item not in sessions[0].baselines]
    return sessions


def _is_from_monitor(alarm: Alarm) -> bool:
    """True if an alarm is the monitor's, and not the recorder's."""
    return not alarm.alarm.startswith(f"{keys.RECORDING}/")


def is_timeout(alarm: Alarm) -> bool:
    """True if an alarm is a raised data timeout of the plant."""
    return alarm.alarm == TIMEOUT_ALARM and alarm.event == Event.RAISED


def _report(sessions: list[Session], health: Health, number: int) -> None:
    start_s = health.time_ns / 1e9 - health.uptime_s
    known = [session for session in sessions if any(abs(item - start_s) <= SAME_START_S for item in session.starts_s)]
    if not known and sessions and _is_resumed(sessions[-1], health):
        sessions[-1].starts_s.append(start_s)
    elif not known:
        if sessions:
            sessions[-1].end = number
        sessions.append(Session([start_s], number, fresh=health.phase == "waiting"))
    elif known[0] is not sessions[-1]:
        raise InputError("holds the reports of two monitors of the plant at the same time; verify takes one")
    sessions[-1].heard_from_ns.update(health.heard_from_ns)
    sessions[-1].lost = health.lost


def _is_resumed(session: Session, health: Health) -> bool:
    """True if the first health message after a start continues a session.

    A new session's first health message has the phase `waiting`. A session too short for a second one has no first
    samples.
    """
    heard_from_ns = dict(health.heard_from_ns)
    return health.phase != "waiting" and (
        heard_from_ns == session.heard_from_ns or (session.fresh and not session.heard_from_ns)
    )
