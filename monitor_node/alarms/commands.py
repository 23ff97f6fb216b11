"""Alarm commands, the queryables `reactor/{plant}/command/{name}`.

Their rate is limited, so that a flood of them delays no alarm: a command that changes something is written to the
disk before it is answered, which takes milliseconds. Senders choose the names in commands, so all names together are
limited, too.
Commands without a name have a limit of their own.
"""

from collections import OrderedDict
from collections.abc import Mapping
from typing import NamedTuple

from google.protobuf.message import Message

from monitor_node.alarms.annunciator import Action, Annunciator
from reactorwatch.contract.alarm_states import Event
from reactorwatch.contract.codec import (
    MAX_NAME,
    DecodeError,
    Encoded,
    Publication,
    check_signature,
    decode,
    decode_command,
)
from reactorwatch.contract.messages_pb2 import Alarm, AlarmCommand, CommandReply, ListAlarms, ShelveAlarm
from reactorwatch.errors import InputError

OTHERS = {Event.RAISED, Event.CLEARED, Event.SHELF_TIME_OVER, Event.SHELVE}
"""Events that are no `AlarmCommand`."""

ACTIONS: Mapping[str, Action] = {event.replace(" ", "_"): event for event in Event if event not in OTHERS}
COMMANDS: Mapping[str, type[Message]] = {
    **dict.fromkeys(ACTIONS, AlarmCommand),
    "shelve": ShelveAlarm,
    "comment": AlarmCommand,
    "list_alarms": ListAlarms,
}
"""Message type by command."""


def execute_command(board: Annunciator, question: Encoded) -> tuple[CommandReply, list[Publication]]:
    """Execute a command.

    Returns:
        The reply, with the alarms it is about, and publications.

    Raises:
        InputError: the command is refused; nothing has changed.
        DecodeError: the payload is not what the command carries; nothing has changed.
    """
    name, command = decode_command(question, COMMANDS)
    if isinstance(command, ListAlarms):
        alarms = board.all_alarms()
        return CommandReply(accepted=True, text=f"{len(alarms)} alarms", alarms=alarms), []
    assert isinstance(command, AlarmCommand | ShelveAlarm), "the catalogue holds no others"
    by, comment = check_signature(command.by, command.comment)
    if isinstance(command, ShelveAlarm):
        publications = board.act(command.alarm, Event.SHELVE, by, comment, command.minutes)
    elif not command.incident:
        publications = board.act(command.alarm, ACTIONS.get(name, "comment"), by, comment)
    elif command.alarm:
        raise InputError(f"name an alarm or an incident, not both; got {command.alarm!r} and {command.incident}")
    elif name != Event.ACKNOWLEDGE:
        raise InputError(f"an incident can be acknowledged and nothing else, got {name}; name an alarm")
    else:
        publications = board.acknowledge_incident(command.incident, by, comment)
        alarms = [item.message for item in publications if isinstance(item.message, Alarm)]
        text = f"incident {command.incident}: {name} by {by}, {len(alarms)} alarms"
        return CommandReply(accepted=True, text=text, alarms=alarms), publications
    alarm = board.alarm(command.alarm)
    return CommandReply(accepted=True, text=f"alarm {command.alarm}: {name} by {by}", alarms=[alarm]), publications


MAX_NAMES = 1000
"""Names with a bucket; the least recently seen is evicted first."""


class Rate(NamedTuple):
    """A token bucket.

    Attributes:
        at_once: capacity, in commands.
        per_s: commands a second that fill it.
    """

    at_once: float
    per_s: float


PER_NAME = Rate(30.0, 5.0)
ALL = Rate(100.0, 20.0)
"""Limit of all names together, and of commands without a name."""


class CommandRateLimiter:
    """Token buckets of commands by their sender's name.

    >>> rate = CommandRateLimiter()
    >>> [rate.check("Anna", now_ns=0) for _ in range(30)] == [None] * 30
    True
    >>> rate.check("Anna", now_ns=0)
    "too many commands by 'Anna': 30 at once and 5 a second are taken; try again in a second"
    >>> rate.check("Anna", now_ns=1_000_000_000) is None
    True
    """

    def __init__(self) -> None:
        self._names: OrderedDict[str, tuple[float, int]] = OrderedDict()  # level of a bucket, and its time
        self._all = {True: (ALL.at_once, 0), False: (ALL.at_once, 0)}  # with a name, without

    def check(self, name: str, now_ns: int) -> str | None:
        """Count a command; returns the reason for its refusal, None if it is accepted."""
        left_all = _level(self._all[bool(name)], ALL, now_ns)
        left = _level(self._names.pop(name, (PER_NAME.at_once, now_ns)), PER_NAME, now_ns) if name else left_all
        refused = left < 1.0 or left_all < 1.0
        spent = 0.0 if refused else 1.0
        self._all[bool(name)] = left_all - spent, now_ns
        if name:
            self._names[name] = left - spent, now_ns
            if len(self._names) > MAX_NAMES:
                self._names.popitem(last=False)
        if not refused:
            return None
        rate, sender = (PER_NAME, f" by {name!r}") if name and left < 1.0 else (ALL, "")
        return (
            f"too many commands{sender}: {rate.at_once:g} at once and {rate.per_s:g} a second are taken; "
            f"try again in a second"
        )


def sender_name(question: Encoded) -> str:
    """Sender's name in a command; empty if it has none, or cannot be decoded."""
    try:
        command = decode(question.payload, question.encoding)
    except DecodeError:
        return ""
    return str(getattr(command, "by", "")).strip()[:MAX_NAME]


def _level(bucket: tuple[float, int], rate: Rate, now_ns: int) -> float:
    """Level of a bucket now; a clock that was set back does not fill it."""
    left, since_ns = bucket
    return min(left + rate.per_s * max(now_ns - since_ns, 0) / 1e9, rate.at_once)
