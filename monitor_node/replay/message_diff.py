"""Difference between recorded and replayed messages, key by key.

Both are in order on each key. A message that the other side does not have is older than the other side's next one.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode, encode

MAX_DIFFERENCES = 100
"""Differences that are listed; the others are counted."""

UNKNOWN = "unknown fields"
NOT_RECORDED, NOT_REPLAYED = "not recorded", "not said again"


class Difference(NamedTuple):
    """Difference of a message.

    Attributes:
        key: key of the message.
        time_ns: sample time of the message.
        what: name of the field; or `UNKNOWN`, for those of a later schema; `NOT_RECORDED`, or `NOT_REPLAYED`.
        recorded: recorded value of the field; empty without a recorded message.
        again: replayed value of the field; empty without a replayed message.
    """

    key: str
    time_ns: int
    what: str
    recorded: str
    again: str


@dataclass
class MatchCount:
    """Number of recorded messages of one kind, and of those that are replayed value for value."""

    recorded: int = 0
    equal: int = 0


class _Replayed(NamedTuple):
    number: int
    publication: Publication
    payload: bytes


@dataclass
class MessageDiff:
    """Compares recorded with replayed messages.

    Attributes:
        counts: counts by kind of message.
        differences: the first differences.
        differing: number of differences.
        unrecorded: number of replayed messages after the last recorded one, when the recording had ended.
    """

    counts: dict[str, MatchCount] = field(default_factory=dict)
    differences: list[Difference] = field(default_factory=list)
    differing: int = 0
    unrecorded: int = 0
    _count: int = 0
    _last_matched: int = -1
    _recorded: dict[str, deque[tuple[Message, bytes]]] = field(default_factory=dict)  # unmatched, by key
    _replayed: dict[str, deque[_Replayed]] = field(default_factory=dict)  # unmatched, by key

    def add_recorded(self, message: Encoded, kind: str) -> None:
        """Add a recorded message."""
        count = self.counts.setdefault(kind, MatchCount())
        count.recorded += 1
        try:
            body = decode(message.payload, message.encoding)
        except DecodeError as error:
            self._differ(Difference(message.key, 0, "payload", str(error), ""))
            return
        self._recorded.setdefault(message.key, deque()).append((body, message.payload))
        self._pair(message.key)

    def add_replayed(self, publications: list[Publication]) -> None:
        """Add replayed messages."""
        for publication in publications:
            item = _Replayed(self._count, publication, encode(publication).payload)
            self._count += 1
            self._replayed.setdefault(publication.key, deque()).append(item)
            self._pair(publication.key)

    def finish(self) -> None:
        """Count the unmatched messages, at the end of a run."""
        for key, recorded in self._recorded.items():
            for body, _ in recorded:
                self._differ(Difference(key, _time_ns(body), NOT_REPLAYED, _text(body), ""))
            recorded.clear()
        for replayed in self._replayed.values():
            for item in replayed:
                if item.number > self._last_matched:
                    self.unrecorded += 1
                else:
                    self._add_unrecorded(item)
            replayed.clear()
        self.differences.sort(key=lambda item: item.time_ns)

    def add(self, other: "MessageDiff") -> None:
        """Add the differences of another run."""
        for kind, count in other.counts.items():
            own = self.counts.setdefault(kind, MatchCount())
            own.recorded, own.equal = own.recorded + count.recorded, own.equal + count.equal
        self.differences = sorted([*self.differences, *other.differences], key=lambda item: item.time_ns)
        del self.differences[MAX_DIFFERENCES:]
        self.differing, self.unrecorded = self.differing + other.differing, self.unrecorded + other.unrecorded

    def _pair(self, key: str) -> None:
        recorded, replayed = self._recorded.get(key), self._replayed.get(key)
        while recorded and replayed:
            body, payload = recorded[0]
            item = replayed[0]
            before, after = _time_ns(body), item.publication.message.time_ns
            if before < after:
                self._differ(Difference(key, before, NOT_REPLAYED, _text(body), ""))
            elif before > after:
                self._add_unrecorded(item)
            else:
                self._last_matched = max(self._last_matched, item.number)
                again = item.publication.message
                same = payload == item.payload and type(body) is type(again)  # two types may have the same bytes
                fields = [] if same else _differing_fields(body, again)
                if fields:
                    self._differ(Difference(key, before, *fields[0]))
                else:
                    self.counts[_kind(key)].equal += 1
            if before <= after:
                recorded.popleft()
            if after <= before:
                replayed.popleft()

    def _add_unrecorded(self, item: _Replayed) -> None:
        body = item.publication.message
        self._differ(Difference(item.publication.key, body.time_ns, NOT_RECORDED, "", _text(body)))

    def _differ(self, difference: Difference) -> None:
        self.differing += 1
        if len(self.differences) < MAX_DIFFERENCES:
            self.differences.append(difference)


def _kind(key: str) -> str:
    topic = keys.parse(key)
    return topic.kind if topic is not None else key


def _time_ns(message: Message) -> int:
    return int(getattr(message, "time_ns", 0))


def _text(message: Message) -> str:
    return " ".join(str(message).split())


def _differing_fields(recorded: Message, again: Message) -> list[tuple[str, str, str]]:
    """Differing fields: name, recorded and replayed value; NaN is equal to itself."""
    if recorded.DESCRIPTOR.full_name != again.DESCRIPTOR.full_name:
        return [("message", recorded.DESCRIPTOR.full_name, again.DESCRIPTOR.full_name)]
    fields = []
    for item in recorded.DESCRIPTOR.fields:
        before, after = (_exact_text(getattr(message, item.name)) for message in (recorded, again))
        if before != after:
            fields.append((item.name, before, after))
    before_bytes, after_bytes = _unknown_bytes(recorded), _unknown_bytes(again)
    if not fields and (before_bytes or after_bytes):
        fields.append((UNKNOWN, f"{before_bytes} bytes", f"{after_bytes} bytes"))
    return fields


def _unknown_bytes(message: Message) -> int:
    """Bytes of fields that this version of the schema does not have."""
    known = type(message)()
    known.CopyFrom(message)
    known.DiscardUnknownFields()
    return message.ByteSize() - known.ByteSize()


def _exact_text(value: Any) -> str:
    """Text of a value on one line, which no other value has: spaces within texts are kept."""
    return repr(value) if isinstance(value, str | int | float) else " ".join(map(str.strip, str(value).splitlines()))
