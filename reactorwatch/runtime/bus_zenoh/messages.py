"""Conversion between Zenoh's keys and messages and this software's."""

import re
import struct
from typing import TypeAlias

import zenoh

from reactorwatch.contract.codec import MAX_PAYLOAD, Encoded
from reactorwatch.runtime.delivery import STREAM_PARTS

MAX_ENCODING = 1000
MAX_KEY = 1000
"""Characters of a key whose messages are put in order. A key may have 65,535, and names of streams are stored."""

WILDCARD = "*"
"""Part of the key of a message published on many keys at once.

Zenoh hands it to the subscribers of all of them, and a router's rules treat it as one on a key of its own.
"""

SEQUENCE_ATTACHMENT = struct.Struct("<QQ")  # publisher, and sequence number in the stream

ReadSample: TypeAlias = tuple[tuple[int, int] | None, Encoded]
"""Publisher and number of a sample, if it has them, and its message."""


def truncated_payload(payload: zenoh.ZBytes) -> bytes:
    """Bytes of a payload; one that is too large is cut to a size that is still refused.

    A node's backlog is bounded in messages, and would otherwise be as large as a sender likes.
    """
    data = payload.to_bytes()
    return data if len(data) <= MAX_PAYLOAD else data[: MAX_PAYLOAD + 1]


class SampleReader:
    """Converts samples of one thread.

    Nearly all have the same encoding, and comparing it is faster than converting it to text.

    Args:
        encoding: encoding expected first.
    """

    def __init__(self, encoding: zenoh.Encoding = zenoh.Encoding.ZENOH_BYTES) -> None:
        self._encoding, self._text = encoding, truncated_encoding(encoding)

    def read(self, sample: zenoh.Sample, now_ns: int) -> ReadSample:
        """Publisher and number, if the sample has them and its key is at most `MAX_KEY`; and the message."""
        encoding = sample.encoding
        if encoding != self._encoding:
            self._encoding, self._text = encoding, truncated_encoding(encoding)
        message = Encoded._make(
            (str(sample.key_expr), truncated_payload(sample.payload), self._text, now_ns)
        )  # the fastest way
        attachment = sample.attachment
        if attachment is None or len(message.key) > MAX_KEY:
            return None, message
        name = attachment.to_bytes()
        return SEQUENCE_ATTACHMENT.unpack(name) if len(name) == SEQUENCE_ATTACHMENT.size else None, message


def truncated_encoding(encoding: zenoh.Encoding) -> str:
    """Text of an encoding; senders control its length, so it is cut."""
    return str(encoding)[:MAX_ENCODING]


def zenoh_expression(key_expression: str) -> str:
    """Key expression in Zenoh's syntax, where a `*` within a part is `$*`."""
    return "/".join(part if part in ("*", "**") else part.replace("*", "$*") for part in key_expression.split("/"))


def matches_whole_streams(key_expression: str) -> bool:
    """True if the expression matches all keys of any stream of which it matches one."""
    *parts, last = key_expression.split("/")
    return last == "**" and len(parts) <= STREAM_PARTS


def first_line(error: Exception | str) -> str:
    """First line of Zenoh's error, without the lines of its source."""
    line = str(error).splitlines()[0] if str(error) else type(error).__name__
    return re.sub(r" at /\S+\.rs:\d+\.?", "", line).rstrip(". ")
