"""Audit records of commands: sender, command and reply. Nodes publish them; recorders store them.

The sender's name is the one in the command. The router's access rules ensure that a client with the right to give it
did; they cannot identify the person.
"""

from google.protobuf import text_format

from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode
from reactorwatch.contract.messages_pb2 import Audit, BaselineCommand, CommandReply, ListAlarms


def is_query(question: Encoded) -> bool:
    """True for a command that asks for something and changes nothing."""
    try:
        command = decode(question.payload, question.encoding)
    except DecodeError:
        return False
    return isinstance(command, ListAlarms) or (isinstance(command, BaselineCommand) and command.what == "list")


def audit(question: Encoded, reply: CommandReply, now_ns: int) -> Publication | None:
    """Make the record of a command and its reply; None for a command that changes nothing, or on an unknown key.

    Args:
        question: the encoded command.
        reply: the node's reply.
        now_ns: time of the reply.
    """
    topic = keys.parse(question.key)
    if topic is None or topic.kind != keys.COMMAND or is_query(question):
        return None
    try:
        command = decode(question.payload, question.encoding)
    except DecodeError:
        command = None  # the reply holds the error
    record = Audit(
        time_ns=now_ns,
        command=topic.name,
        by=str(getattr(command, "by", "")),
        accepted=reply.accepted,
        text=reply.text,
        request="" if command is None else text_format.MessageToString(command, as_one_line=True),
    )
    return Publication(keys.key(topic.plant, keys.AUDIT, topic.name), record)
