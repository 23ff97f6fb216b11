"""Alarm commands, the queryables `reactor/{plant}/command/{name}`."""

from collections.abc import Mapping

from google.protobuf.message import Message

from monitor_node.alarms.annunciator import Action, Annunciator
from reactorwatch.contract.alarm_states import Event
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.commands import check_signature, decode_command
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
