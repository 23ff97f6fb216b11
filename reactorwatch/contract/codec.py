"""Encode and decode messages; decode and check commands on `reactor/{plant}/command/{name}`, for all nodes.

The bytes on the bus carry an encoding, `application/protobuf;reactorwatch.v1.Sample`, which names the message and its
version. A payload is decoded by that name only, so foreign bytes on a key are refused: protobuf itself would decode
many of them as an empty message.
"""

import copyreg
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeAlias, get_args

from google.protobuf.message import DecodeError as ProtobufDecodeError
from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract import messages_pb2 as messages
from reactorwatch.errors import InputError

PREFIX = "application/protobuf;"

PACKAGE, VERSION = "reactorwatch.", "reactorwatch.v1"
OTHER_VERSION = "version"
"""Reason of a `DecodeError` for messages of this software in another version of their schema."""

MAX_PAYLOAD = 1 << 20
"""Largest payload that is decoded, in bytes; messages take less than a hundredth of it."""

Body: TypeAlias = (
    messages.Sample
    | messages.Estimate
    | messages.ModelSnapshot
    | messages.ChartPoint
    | messages.Alarm
    | messages.AlarmKpis
    | messages.Incident
    | messages.Reconstruction
    | messages.Baseline
    | messages.Promise
    | messages.Health
    | messages.Fault
    | messages.Audit
)
"""Messages that are published; each has `time_ns`."""

MESSAGES: tuple[type[Message], ...] = (
    *get_args(Body),
    messages.SetInput,
    messages.InjectFault,
    messages.ClearFault,
    messages.AlarmCommand,
    messages.ShelveAlarm,
    messages.ListAlarms,
    messages.BaselineCommand,
    messages.CommandReply,
)


class Publication(NamedTuple):
    """A message and the key to publish it on, as every core returns them."""

    key: str
    message: Body


class Encoded(NamedTuple):
    """Encoded message of a bus or a file; `received_ns` is its time of arrival, 0 for one that is sent."""

    key: str
    payload: bytes
    encoding: str
    received_ns: int = 0


class DecodeError(ValueError):
    """Bytes that do not match their encoding. `reason` is a word to count by."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


def encoding_of(message_type: type[Message]) -> str:
    """Encoding of a message type.

    >>> encoding_of(messages.Sample)
    'application/protobuf;reactorwatch.v1.Sample'
    """
    return PREFIX + message_type.DESCRIPTOR.full_name


_BY_ENCODING: dict[str, type[Message]] = {encoding_of(kind): kind for kind in MESSAGES}
_READERS: dict[str, Callable[[bytes], Message]] = {text: kind.FromString for text, kind in _BY_ENCODING.items()}
_ENCODINGS: dict[type[Message], str] = {kind: text for text, kind in _BY_ENCODING.items()}


def message_type(encoding: str) -> type[Message] | None:
    """Message type of an encoding; None if it is unknown."""
    return _BY_ENCODING.get(encoding)


def encode(publication: Publication) -> Encoded:
    """Encode a publication."""
    message = publication.message
    return Encoded(publication.key, message.SerializeToString(), _ENCODINGS[type(message)])


def encode_message(message: Message) -> tuple[bytes, str]:
    """Encode any message of `MESSAGES`; returns its bytes and their encoding."""
    return message.SerializeToString(), _ENCODINGS[type(message)]


def decode(payload: bytes, encoding: str) -> Message:
    """Decode a payload as the message that the encoding names.

    Raises:
        DecodeError: the encoding is unknown (reason `encoding`) or of another version of the schema (`version`), the
            payload is too large (`too_large`) or malformed (`payload`).
    """
    if len(payload) > MAX_PAYLOAD:
        raise DecodeError("too_large", f"a payload must have at most {MAX_PAYLOAD} bytes, got {len(payload)}")
    read = _READERS.get(encoding)
    if read is None:
        is_other = encoding.startswith(PREFIX + PACKAGE) and not encoding.startswith(f"{PREFIX}{VERSION}.")
        reason = OTHER_VERSION if is_other else "encoding"
        raise DecodeError(reason, f"encoding must be '{PREFIX}{VERSION}.<message>', got {encoding!r}")
    try:
        return read(payload)
    except ProtobufDecodeError as error:
        name = encoding.removeprefix(PREFIX)
        raise DecodeError("payload", f"{len(payload)} bytes are not a {name}: {error}") from error


def _reduce(message: Message) -> tuple[Callable[[bytes, str], Message], tuple[bytes, str]]:
    return decode, encode_message(message)


for _kind in MESSAGES:  # pickle would import the generated module by a name that it does not have here
    copyreg.pickle(_kind, _reduce)


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
