"""Conversion between Zenoh's keys and messages and this software's."""

import re
import struct
import time
from dataclasses import dataclass
from math import isfinite
from typing import Any, TypeAlias

import zenoh
from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract.codec import MAX_PAYLOAD, Encoded, encode_message
from reactorwatch.runtime.bus import MAX_BATCH
from reactorwatch.runtime.delivery import STREAM_PARTS

MAX_ENCODING = 1000
MAX_KEY = 1000
"""Characters of a key whose messages are put in order. A key may have 65,535, and names of streams are stored."""

WILDCARD = "*"
"""Part of the key of a message published on many keys at once.

Zenoh hands it to the subscribers of all of them, and a router's rules treat it as one on a key of its own.
"""

SEQUENCE_ATTACHMENT = struct.Struct("<QQ")  # publisher, and sequence number in the stream

EVERY_ROW = frozenset({keys.SAMPLE, keys.ESTIMATE, keys.RECONSTRUCTION, keys.CHART})
"""Kinds published with every row, apart from `RARE_CHARTS`. Others would keep `cache_messages` filled for days."""
RARE_CHARTS = frozenset({"parameters"})
MAX_CACHED_OF_OTHERS = 600
"""Messages cached on each key of another kind: those of `history_s` at one a plant minute and `--speed 600`."""

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


@dataclass(frozen=True)
class ZenohRequest:
    """A query from the network."""

    query: zenoh.Query
    question: Encoded

    def reply(self, message: Message) -> None:
        """See `Request`."""
        payload, encoding = encode_message(message)
        self.query.reply(self.question.key, payload, encoding=encoding)
        self.query.drop()

    def decline(self) -> None:
        """See `Request`; the client waits until no queryable holds its query any more."""
        self.query.drop()


def cache_size(key: str, cache_messages: int) -> int:
    """Number of messages that a publisher caches on a key.

    Args:
        key: the key.
        cache_messages: number of messages cached on a key that is published with every row.
    """
    topic = keys.parse(key)
    is_of_every_row = topic is not None and topic.kind in EVERY_ROW and topic.name.split("/")[0] not in RARE_CHARTS
    return cache_messages if is_of_every_row else min(cache_messages, MAX_CACHED_OF_OTHERS)


def read_batch(channel: Any, reader: SampleReader) -> list[ReadSample]:
    """Wait for a sample, and read it and those that have arrived until then."""
    sample, now_ns = channel.recv(), time.time_ns()
    batch, room = list[ReadSample](), 1 << 20
    while sample is not None:
        read = reader.read(sample, now_ns)
        batch.append(read)
        room -= len(read[1][1])  # of its payload
        sample = channel.try_recv() if len(batch) < MAX_BATCH and room > 0 else None
    return batch


def history_selector(seconds: float) -> str:
    """Selector for a publisher's cache."""
    return f"_time=[now(-{seconds}s)..]" if isfinite(seconds) else ""
