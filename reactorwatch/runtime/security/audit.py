"""The record of what nodes were told to do: by whom, what, and what came of it. Nodes publish it; recorders keep it.

Who gave a command is what the command says. That somebody with the right to give it did is what the router's access
rules see to; which person it was, they cannot.
"""

from google.protobuf import text_format

from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode
from reactorwatch.contract.messages_pb2 import Audit, CommandReply, ListAlarms


def audit(question: Encoded, reply: CommandReply, now_ns: int) -> Publication | None:
    """The record of a command and its answer; None for a question that changes nothing, or on no key of ours.

    Args:
        question: the command as it came.
        reply: what the node answered.
        now_ns: when.
    """
    topic = keys.parse(question.key)
    if topic is None or topic.kind != keys.COMMAND:
        return None
    try:
        command = decode(question.payload, question.encoding)
    except DecodeError:
        command = None  # the answer says what was wrong with it
    if isinstance(command, ListAlarms):
        return None
    record = Audit(
        time_ns=now_ns,
        command=topic.name,
        by=str(getattr(command, "by", "")),
        accepted=reply.accepted,
        text=reply.text,
        request="" if command is None else text_format.MessageToString(command, as_one_line=True),
    )
    return Publication(keys.key(topic.plant, keys.AUDIT, topic.name), record)
