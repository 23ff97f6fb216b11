"""The past of a run that a viewer joins late: its active alarms, and the time that its minutes count from.

Publishers remember the last minute only. So the nodes that raise alarms are asked for them, and the monitor's report of
health says when the run's first sample came.
"""

import contextlib
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode, encode, encode_message
from reactorwatch.runtime.bus import Bus
from recorder.run_reader import LISTED, SUSPECTED

ANSWER_WITHIN_S = 5.0
COMMANDS = ("list_alarms", keys.LIST_RECORDER_ALARMS)


class Past(NamedTuple):
    """Alarms and zero of a run before a viewer joined it.

    Attributes:
        alarms: messages of the changes that led to the alarms' present state.
        zero_ns: the time of the run's first sample; None: no monitor says it.
    """

    alarms: tuple[Encoded, ...] = ()
    zero_ns: int | None = None


def ask_for_past(bus: Bus, plant: str) -> Past:
    """Ask the nodes of a plant for its past; nodes that are not there are not waited for."""
    listed: list[messages.Alarm] = []
    for command in COMMANDS:
        question = Encoded(keys.key(plant, keys.COMMAND, command), *encode_message(messages.ListAlarms()))
        for reply in _decoded(bus.ask(question, ANSWER_WITHIN_S)):
            if isinstance(reply, messages.CommandReply):
                listed += reply.alarms
    zero_ns: int | None = None
    for health in _decoded(bus.recall(keys.all_of(plant, keys.HEALTH))):
        if isinstance(health, messages.Health) and health.heard_from_ns:
            zero_ns = min(health.heard_from_ns.values())
    alarms = (encode(Publication(keys.key(plant, keys.ALARM, item.alarm), item)) for item in changes(listed))
    return Past(tuple(alarms), zero_ns)


def changes(listed: Iterable[messages.Alarm]) -> Iterator[messages.Alarm]:
    """The changes that led to the present state of alarms, as far as a list of them tells.

    An alarm was raised, and perhaps cleared, when it says; that it is acknowledged or shelved is known from now on. The
    suspects of an incident stand at its last alarm.
    """
    last: dict[int, messages.Alarm] = {}  # of each incident
    for alarm in listed:
        if alarm.state == messages.ALARM_STATE_NORMAL:
            continue
        if alarm.raised_ns:
            yield _changed(alarm, alarm.raised_ns, "raised", messages.ALARM_STATE_UNACKNOWLEDGED)
            if alarm.suspects and alarm.raised_ns >= last.get(alarm.incident, alarm).raised_ns:
                last[alarm.incident] = alarm
        if alarm.cleared_ns and alarm.state == messages.ALARM_STATE_RETURNED_UNACKNOWLEDGED:
            yield _changed(alarm, alarm.cleared_ns, "cleared", alarm.state)
        elif alarm.state != messages.ALARM_STATE_UNACKNOWLEDGED:
            yield _changed(alarm, alarm.time_ns, LISTED, alarm.state)
    for alarm in last.values():
        yield _changed(alarm, alarm.raised_ns, SUSPECTED, messages.ALARM_STATE_UNACKNOWLEDGED)


def _changed(alarm: messages.Alarm, time_ns: int, event: str, state: messages.AlarmState) -> messages.Alarm:
    change = messages.Alarm()
    change.CopyFrom(alarm)
    change.time_ns, change.event, change.state = time_ns, event, state
    return change


def _decoded(came: Iterable[Encoded]) -> Iterator[Message]:
    for item in came:
        with contextlib.suppress(DecodeError):
            yield decode(item.payload, item.encoding)
