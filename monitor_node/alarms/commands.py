"""Alarm commands, the queryables `reactor/{plant}/command/{name}`."""

from collections.abc import Mapping

from google.protobuf.message import Message

from monitor_node.alarms.annunciator import Annunciator
from reactorwatch.contract.alarm_states import Event
from reactorwatch.contract.codec import Encoded, Publication
from reactorwatch.contract.commands import check_signature, decode_command
from reactorwatch.contract.messages_pb2 import Alarm, AlarmCommand, CommandReply, ListAlarms, ShelveAlarm
from reactorwatch.errors import InputError

EVENTS: Mapping[str, Event] = {
    event.replace(" ", "_"): event
    for event in (
        Event.ACKNOWLEDGE,
        Event.UNSHELVE,
        Event.SUPPRESS,
        Event.UNSUPPRESS,
        Event.TAKE_OUT_OF_SERVICE,
        Event.RETURN_TO_SERVICE,
    )
}
COMMANDS: Mapping[str, type[Message]] = {
    **dict.fromkeys(EVENTS, AlarmCommand),
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
    if isinstance(command, AlarmCommand) and command.incident:
        return _act_on_incident(board, name, command, by, comment)
    if isinstance(command, ShelveAlarm):
        publications = board.shelve(command.alarm, command.minutes, by, comment)
    elif name == "comment":
        publications = board.comment(command.alarm, by, comment)
    else:
        publications = board.act(command.alarm, EVENTS[name], by, comment)
    alarm = board.alarm(command.alarm)
    return CommandReply(accepted=True, text=f"alarm {command.alarm}: {name} by {by}", alarms=[alarm]), publications


def _act_on_incident(
    board: Annunciator, name: str, command: AlarmCommand, by: str, comment: str
) -> tuple[CommandReply, list[Publication]]:
    if command.alarm:
        raise InputError(f"name an alarm or an incident, not both; got {command.alarm!r} and {command.incident}")
    if name != Event.ACKNOWLEDGE:
        raise InputError(f"an incident can be acknowledged and nothing else, got {name}; name an alarm")
    publications = board.acknowledge_incident(command.incident, by, comment)
    alarms = [item.message for item in publications if isinstance(item.message, Alarm)]
    text = f"incident {command.incident}: {name} by {by}, {len(alarms)} alarms"
    return CommandReply(accepted=True, text=text, alarms=alarms), publications
