"""What somebody asks of a node by `reactor/{plant}/command/{name}`, read and checked alike by all that are asked."""

from collections.abc import Mapping

from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, decode, encoding_of
from reactorwatch.errors import InputError

LONGEST_NAME = 64
LONGEST_COMMENT = 1000


def command_in(question: Encoded, catalogue: Mapping[str, type[Message]]) -> tuple[str, Message]:
    """The name of a command and what it carries.

    Args:
        question: that was asked.
        catalogue: the node's commands and what they carry.

    Raises:
        InputError: there is no such command.
        DecodeError: the payload is not what the command carries.
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


def signed(by: str, comment: str) -> tuple[str, str]:
    """Who did something to an alarm, and why, without the blanks around.

    Raises:
        InputError: nobody, or more than an alarm can hold.
    """
    by, comment = by.strip(), comment.strip()
    if not 1 <= len(by) <= LONGEST_NAME:
        raise InputError(f"by must name the person, in 1 to {LONGEST_NAME} characters, got {by[:LONGEST_NAME]!r}")
    if len(comment) > LONGEST_COMMENT:
        raise InputError(f"comment must have at most {LONGEST_COMMENT} characters, got {len(comment)}")
    return by, comment
