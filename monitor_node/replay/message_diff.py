"""Two streams of messages held against each other, key by key: what was recorded, and what is said again. Pure.

Both are in order on each key. Where one has a message that the other has not, its time says so: it is older than what
the other has next.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from google.protobuf.message import Message

from reactorwatch.contract import keys
from reactorwatch.contract.codec import DecodeError, Encoded, Publication, decode, encode

MOST_TOLD = 100
"""Differences that are told one by one; the others are counted."""

NOT_RECORDED, NOT_SAID_AGAIN = "not recorded", "not said again"


class Difference(NamedTuple):
    """Something that differs.

    Attributes:
        key: the key it is on.
        time_ns: of the sample that it speaks of.
        what: the field that differs; or `NOT_RECORDED`, or `NOT_SAID_AGAIN`.
        recorded: the field as recorded; empty if the message was not recorded.
        again: the field as it is said again; empty if the message is not.
    """

    key: str
    time_ns: int
    what: str
    recorded: str
    again: str


@dataclass
class Count:
    """How many messages of one kind were recorded, and how many of them are said again, value for value."""

    recorded: int = 0
    equal: int = 0


class _Said(NamedTuple):
    number: int
    publication: Publication
    payload: bytes


@dataclass
class Comparison:
    """Holds what is recorded against what is said again.

    Attributes:
        counts: by kind of message.
        differences: the first of them.
        differing: how many there are.
        unrecorded: messages that are said again after the last one that was recorded: the recording had ended.
    """

    counts: dict[str, Count] = field(default_factory=dict)
    differences: list[Difference] = field(default_factory=list)
    differing: int = 0
    unrecorded: int = 0
    _said: int = 0
    _last_matched: int = -1
    _recorded_waits: dict[str, deque[tuple[Message, bytes]]] = field(default_factory=dict)
    _again_waits: dict[str, deque[_Said]] = field(default_factory=dict)

    def recorded(self, message: Encoded, kind: str) -> None:
        """Take in what was recorded."""
        count = self.counts.setdefault(kind, Count())
        count.recorded += 1
        try:
            body = decode(message.payload, message.encoding)
        except DecodeError as error:
            self._differ(Difference(message.key, 0, "payload", str(error), ""))
            return
        self._recorded_waits.setdefault(message.key, deque()).append((body, message.payload))
        self._pair(message.key)

    def again(self, publications: list[Publication]) -> None:
        """Take in what is said again."""
        for publication in publications:
            said = _Said(self._said, publication, encode(publication).payload)
            self._said += 1
            self._again_waits.setdefault(publication.key, deque()).append(said)
            self._pair(publication.key)

    def finish(self) -> None:
        """Nothing more comes of either, or what does is of another run."""
        for key, waiting in self._recorded_waits.items():
            for body, _ in waiting:
                self._differ(Difference(key, _time_ns(body), NOT_SAID_AGAIN, _text(body), ""))
            waiting.clear()
        for waits in self._again_waits.values():
            for said in waits:
                if said.number > self._last_matched:
                    self.unrecorded += 1
                else:
                    self._is_not_recorded(said)
            waits.clear()
        self.differences.sort(key=lambda item: item.time_ns)

    def _pair(self, key: str) -> None:
        recorded, again = self._recorded_waits.get(key), self._again_waits.get(key)
        while recorded and again:
            body, payload = recorded[0]
            said = again[0]
            before, after = _time_ns(body), said.publication.message.time_ns
            if before < after:
                self._differ(Difference(key, before, NOT_SAID_AGAIN, _text(body), ""))
            elif before > after:
                self._is_not_recorded(said)
            else:
                self._last_matched = max(self._last_matched, said.number)
                different = [] if payload == said.payload else _different(body, said.publication.message)
                if different:
                    self._differ(Difference(key, before, *different[0]))
                else:
                    self.counts[_kind(key)].equal += 1
            if before <= after:
                recorded.popleft()
            if after <= before:
                again.popleft()

    def _is_not_recorded(self, said: _Said) -> None:
        body = said.publication.message
        self._differ(Difference(said.publication.key, body.time_ns, NOT_RECORDED, "", _text(body)))

    def _differ(self, difference: Difference) -> None:
        self.differing += 1
        if len(self.differences) < MOST_TOLD:
            self.differences.append(difference)


def _kind(key: str) -> str:
    topic = keys.parse(key)
    return topic.kind if topic is not None else key


def _time_ns(message: Message) -> int:
    return int(getattr(message, "time_ns", 0))


def _text(message: Message) -> str:
    return " ".join(str(message).split())


def _different(recorded: Message, again: Message) -> list[tuple[str, str, str]]:
    """The fields that differ, each as recorded and as said again; NaN is equal to itself."""
    if recorded.DESCRIPTOR.full_name != again.DESCRIPTOR.full_name:
        return [("message", recorded.DESCRIPTOR.full_name, again.DESCRIPTOR.full_name)]
    found = []
    for item in recorded.DESCRIPTOR.fields:
        before, after = (_shown(getattr(message, item.name)) for message in (recorded, again))
        if before != after:
            found.append((item.name, before, after))
    return found


def _shown(value: Any) -> str:
    return repr(value) if isinstance(value, str | int | float) else " ".join(str(value).split())
