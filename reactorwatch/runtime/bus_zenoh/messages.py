"""Keys and messages as Zenoh has them, and as we have."""

import re
import struct

import zenoh

from reactorwatch.contract.codec import LARGEST_PAYLOAD, Encoded
from reactorwatch.runtime.delivery.delivery import Numbered
from reactorwatch.runtime.delivery.streams import STREAM_PARTS

LONGEST_ENCODING = 1000
LONGEST_KEY = 1000
"""Characters of a key whose messages are put in order. A key may have 65,535, and the names of streams are kept."""

NUMBERED = struct.Struct("<QQ")  # who published a message, and its number in the stream


def payload_of(payload: zenoh.ZBytes) -> bytes:
    """A payload; one that is too large for any message of ours is cut to a size that still is, so that it is refused.

    What waits for a node is counted in messages, and would otherwise be as large as a stranger likes.
    """
    data = payload.to_bytes()
    return data if len(data) <= LARGEST_PAYLOAD else data[: LARGEST_PAYLOAD + 1]


class Reader:
    """Reads what comes, in one thread.

    Nearly all comes with the same encoding, and to ask Zenoh for its text takes longer than to ask whether it is.

    Args:
        encoding: that is expected first.
    """

    def __init__(self, encoding: zenoh.Encoding = zenoh.Encoding.ZENOH_BYTES) -> None:
        self._encoding, self._text = encoding, encoding_text(encoding)

    def read(self, sample: zenoh.Sample, now_ns: int) -> tuple[tuple[int, int] | None, Encoded]:
        """A message, and before it its publisher and number, if it has them and its key is at most `LONGEST_KEY`."""
        encoding = sample.encoding
        if encoding != self._encoding:
            self._encoding, self._text = encoding, encoding_text(encoding)
        message = Encoded._make(
            (str(sample.key_expr), payload_of(sample.payload), self._text, now_ns)
        )  # the fastest way
        attachment = sample.attachment
        if attachment is None or len(message.key) > LONGEST_KEY:
            return None, message
        name = attachment.to_bytes()
        return NUMBERED.unpack(name) if len(name) == NUMBERED.size else None, message


def is_wild(key: str) -> bool:
    """True for the key of a message that is on many keys at once.

    Zenoh hands it to the subscribers of all of them, and a router's rules cannot tell it from one on a key of its own.
    """
    return "*" in key


def encoding_text(encoding: zenoh.Encoding) -> str:
    """What an encoding says; none of ours is as long as a stranger's may be."""
    return str(encoding)[:LONGEST_ENCODING]


def numbered(sample: zenoh.Sample, now_ns: int) -> Numbered | Encoded:
    """A message that has come by itself, see `Reader`; with its number if it has one."""
    who, message = Reader(sample.encoding).read(sample, now_ns)
    return message if who is None else Numbered(*who, message)


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
