"""Decoding and checks of commands on `reactor/{plant}/command/{name}`, shared by all nodes."""

from collections.abc import Mapping

from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode, encoding_of
from reactorwatch.errors import InputError

MAX_NAME = 64  # as long as the name of a plant
MAX_COMMENT = 1000  # some sentences; every alarm carries it


def decode_command(question: Encoded, catalogue: Mapping[str, type[Message]]) -> tuple[str, Message]:
    """Decode a command; returns its name and message.

    Args:
        question: the encoded command.
        catalogue: message types of the node's commands, by name.

    Raises:
        InputError: there is no such command.
        DecodeError: the payload is not a message of the command's type.
    """
    topic = keys.parse(question.key)
    name = topic.name if topic is not None and topic.kind == keys.COMMAND else question.key
    if name not in catalogue:
        raise InputError(f"unknown command {name!r} (valid: {', '.join(catalogue)})")
    command = decode(question.payload, question.encoding)
    if type(command) is not catalogue[name]:
        wanted = encoding_of(catalogue[name])
        raise DecodeError("encoding", f"command {name} must carry {wanted!r}, got {question.encoding!r}")
    return name, command


def check_signature(by: str, comment: str) -> tuple[str, str]:
    """Check the operator's name and comment on an alarm; returns them without surrounding blanks.

    Raises:
        InputError: the name is empty, or one of them is too long.
    """
    by, comment = by.strip(), comment.strip()
    if not 1 <= len(by) <= MAX_NAME:
        raise InputError(f"by must name the person, in 1 to {MAX_NAME} characters, got {by[:MAX_NAME]!r}")
    if len(comment) > MAX_COMMENT:
        raise InputError(f"comment must have at most {MAX_COMMENT} characters, got {len(comment)}")
    return by, comment
