"""Between messages and bytes.

The bytes on the bus carry an encoding, `application/protobuf;reactorwatch.v1.Sample`, which names the message
and its version. A payload is decoded by that name alone, so a stranger's bytes on one of our keys are refused
instead of guessed at: protobuf itself would take many of them for an empty message.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

from google.protobuf.message import DecodeError as ProtobufDecodeError
from google.protobuf.message import Message

from reactorwatch.contract import messages_pb2 as messages

PREFIX = "application/protobuf;"

LARGEST_PAYLOAD = 1 << 20
"""Bytes. Messages of ours take less than a hundredth of it; what is larger is not read."""

MESSAGES: tuple[type[Message], ...] = (
    messages.Sample,
    messages.Estimate,
    messages.ModelSnapshot,
    messages.ChartPoint,
    messages.Alarm,
    messages.AlarmKpis,
    messages.Reconstruction,
    messages.Health,
    messages.Fault,
    messages.Audit,
    messages.SetInput,
    messages.InjectFault,
    messages.ClearFault,
    messages.AlarmCommand,
    messages.ShelveAlarm,
    messages.ListAlarms,
    messages.ReplayCommand,
    messages.CommandReply,
)

Body: TypeAlias = (
    messages.Sample
    | messages.Estimate
    | messages.ModelSnapshot
    | messages.ChartPoint
    | messages.Alarm
    | messages.AlarmKpis
    | messages.Reconstruction
    | messages.Health
    | messages.Fault
    | messages.Audit
)
"""What travels by publication; each has `time_ns`."""


class Publication(NamedTuple):
    """A message and the key it goes out on: what every core returns."""

    key: str
    message: Body


class Encoded(NamedTuple):
    """Bytes as they arrive from, or go to, a bus or a file; `received_ns` is when they arrived, 0 if they did not."""

    key: str
    payload: bytes
    encoding: str
    received_ns: int = 0


class DecodeError(ValueError):
    """Bytes that are not what they claim to be. `reason` is a word to count by."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


def encoding_of(message_type: type[Message]) -> str:
    """The encoding that goes with a message type.

    >>> encoding_of(messages.Sample)
    'application/protobuf;reactorwatch.v1.Sample'
    """
    return PREFIX + message_type.DESCRIPTOR.full_name


_BY_ENCODING: dict[str, type[Message]] = {encoding_of(kind): kind for kind in MESSAGES}
_READERS: dict[str, Callable[[bytes], Message]] = {text: kind.FromString for text, kind in _BY_ENCODING.items()}
_ENCODINGS: dict[type[Message], str] = {kind: text for text, kind in _BY_ENCODING.items()}


def message_type(encoding: str) -> type[Message] | None:
    """The message type that an encoding names; None if it is not one of ours."""
    return _BY_ENCODING.get(encoding)


def encode(publication: Publication) -> Encoded:
    """The bytes of a publication, with their encoding."""
    message = publication.message
    return Encoded(publication.key, message.SerializeToString(), _ENCODINGS[type(message)])


def encode_message(message: Message) -> tuple[bytes, str]:
    """The bytes of any of our messages, and their encoding."""
    return message.SerializeToString(), _ENCODINGS[type(message)]


def decode(payload: bytes, encoding: str) -> Message:
    """The message that the encoding names, read from the bytes.

    Raises:
        DecodeError: the encoding is not ours (reason `encoding`), the bytes are too many (`too_large`), or do not parse
            (`payload`).
    """
    if len(payload) > LARGEST_PAYLOAD:
        raise DecodeError("too_large", f"a payload must have at most {LARGEST_PAYLOAD} bytes, got {len(payload)}")
    read = _READERS.get(encoding)
    if read is None:
        raise DecodeError("encoding", f"encoding must be '{PREFIX}reactorwatch.v1.<message>', got {encoding!r}")
    try:
        return read(payload)
    except ProtobufDecodeError as error:
        name = encoding.removeprefix(PREFIX)
        raise DecodeError("payload", f"{len(payload)} bytes are not a {name}: {error}") from error
