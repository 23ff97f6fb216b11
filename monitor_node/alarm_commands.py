"""What people may ask of the alarms, by the queryables `reactor/{plant}/command/{name}`."""

from collections.abc import Mapping

from google.protobuf.message import Message

from monitor_node.alarm_board import AlarmBoard
from monitor_node.alarm_states import Event
from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode, encoding_of
from reactorwatch.contract.messages_pb2 import AlarmCommand, CommandReply, ListAlarms, ShelveAlarm
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
"""The commands and what they carry."""

LONGEST_NAME = 64
LONGEST_COMMENT = 1000


def obey(board: AlarmBoard, question: Encoded) -> tuple[CommandReply, list[Publication]]:
    """Do what is asked.

    Returns:
        The answer, with the alarms that were asked about, and what is to be published.

    Raises:
        InputError: it cannot be done; nothing has changed.
        DecodeError: the payload is not what the command carries; nothing has changed.
    """
    topic = keys.parse(question.key)
    name = topic.name if topic is not None and topic.kind == keys.COMMAND else question.key
    if name not in COMMANDS:
        raise InputError(f"unknown command {name!r} (valid: {', '.join(COMMANDS)})")
    command = decode(question.payload, question.encoding)
    if type(command) is not COMMANDS[name]:
        wanted = encoding_of(COMMANDS[name])
        raise DecodeError("encoding", f"command {name} must carry {wanted!r}, got {question.encoding!r}")
    if isinstance(command, ListAlarms):
        alarms = board.all_alarms()
        return CommandReply(accepted=True, text=f"{len(alarms)} alarms", alarms=alarms), []
    assert isinstance(command, AlarmCommand | ShelveAlarm), "the catalogue holds no others"
    by, comment = command.by.strip(), command.comment.strip()
    if not 1 <= len(by) <= LONGEST_NAME:
        raise InputError(f"by must name the person, in 1 to {LONGEST_NAME} characters, got {by[:LONGEST_NAME]!r}")
    if len(comment) > LONGEST_COMMENT:
        raise InputError(f"comment must have at most {LONGEST_COMMENT} characters, got {len(comment)}")
    if isinstance(command, ShelveAlarm):
        said = board.shelve(command.alarm, command.minutes, by, comment)
    elif name == "comment":
        said = board.comment(command.alarm, by, comment)
    else:
        said = board.act(command.alarm, EVENTS[name], by, comment)
    alarm = board.alarm(command.alarm)
    return CommandReply(accepted=True, text=f"alarm {command.alarm}: {name} by {by}", alarms=[alarm]), said
