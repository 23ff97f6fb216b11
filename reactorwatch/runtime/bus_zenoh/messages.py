"""Keys and messages as Zenoh has them, and as we have."""

import re
import struct

import zenoh

from reactorwatch.contract.codec import LARGEST_PAYLOAD, Encoded
from reactorwatch.runtime.delivery import Numbered

LONGEST_ENCODING = 1000
STREAM_PARTS = 3  # of a key: root, plant and kind

NUMBERED = struct.Struct("<QQ")  # who published a message, and its number in the stream


def stream_of(key: str) -> str:
    """The stream that a key is in."""
    return "/".join(key.split("/", STREAM_PARTS)[:STREAM_PARTS])


def payload_of(payload: zenoh.ZBytes) -> bytes:
    """A payload; one that is too large for any message of ours is cut to a size that still is, so that it is refused.

    What waits for a node is counted in messages, and would otherwise be as large as a stranger likes.
    """
    data = payload.to_bytes()
    return data if len(data) <= LARGEST_PAYLOAD else data[: LARGEST_PAYLOAD + 1]


def numbered(sample: zenoh.Sample, now_ns: int) -> Numbered | Encoded:
    """A message that has come, as its publisher numbered it; without a number if it did not."""
    message = Encoded(str(sample.key_expr), payload_of(sample.payload), str(sample.encoding)[:LONGEST_ENCODING], now_ns)
    attachment = sample.attachment
    if attachment is None:
        return message
    name = attachment.to_bytes()
    if len(name) != NUMBERED.size:
        return message
    publisher, number = NUMBERED.unpack(name)
    return Numbered(publisher, stream_of(message.key), number, message)


def spelled(key_expression: str) -> str:
    """As Zenoh writes it: a `*` that is only a part of a part is `$*` there."""
    return "/".join(part if part in ("*", "**") else part.replace("*", "$*") for part in key_expression.split("/"))


def is_of_whole_streams(key_expression: str) -> bool:
    """Whether who listens to it hears all of any stream that it hears anything of."""
    *parts, last = key_expression.split("/")
    return last == "**" and len(parts) <= STREAM_PARTS


def first_line(error: Exception) -> str:
    """What Zenoh says, without the places in its source where it said so."""
    line = str(error).splitlines()[0] if str(error) else type(error).__name__
    return re.sub(r" at /\S+\.rs:\d+\.?", "", line).rstrip(". ")
