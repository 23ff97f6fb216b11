"""A replayed message that differs in anything from the recorded one is a difference that names the field."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from google.protobuf.descriptor import FieldDescriptor

from monitor_node.replay.message_diff import NOT_RECORDED, NOT_REPLAYED, UNKNOWN, Difference, MessageDiff
from monitor_node.replay.verification import COMPARED
from reactorwatch.contract import keys
from reactorwatch.contract.codec import Body, Publication, encode
from reactorwatch.contract.messages_pb2 import (
    Alarm,
    AlarmKpis,
    Baseline,
    ChartPoint,
    Estimate,
    Incident,
    ModelSnapshot,
    Promise,
    Reconstruction,
)

TYPES: dict[str, type[Body]] = {
    keys.ESTIMATE: Estimate,
    keys.MODEL: ModelSnapshot,
    keys.CHART: ChartPoint,
    keys.ALARM: Alarm,
    keys.INCIDENT: Incident,
    keys.ALARM_KPIS: AlarmKpis,
    keys.RECONSTRUCTION: Reconstruction,
    keys.BASELINE: Baseline,
    keys.PROMISE: Promise,
}
Change = Callable[[Any], None]


def is_map(item: FieldDescriptor) -> bool:
    kind = item.message_type
    return kind is not None and bool(kind.GetOptions().map_entry)


def fill(message: Any, number: int = 1, depth: int = 3) -> Any:
    """A message with a value in every field, which depends on a number, and two in those that repeat."""
    for item in message.DESCRIPTOR.fields:
        part = getattr(message, item.name)
        if is_map(item):
            key, value = item.message_type.fields
            for other in (1, 2):
                part[f"k{other}" if key.type == key.TYPE_STRING else other] = scalar(value, other)
        elif item.message_type is not None and item.is_repeated and depth:
            for other in (1, 2):
                fill(part.add(), other, depth - 1)
        elif item.message_type is not None and depth:
            fill(part, number, depth - 1)
        elif item.message_type is None and item.is_repeated:
            part.extend([scalar(item, 1), scalar(item, 2)])
        elif item.message_type is None:
            setattr(message, item.name, scalar(item, number))
    return message


def scalar(item: FieldDescriptor, number: int) -> Any:
    kinds = {item.CPPTYPE_STRING: f"text {number}", item.CPPTYPE_BOOL: number < 3}
    if item.type == item.TYPE_BYTES:
        return bytes([number])
    is_float = item.cpp_type in (item.CPPTYPE_DOUBLE, item.CPPTYPE_FLOAT)
    return kinds.get(item.cpp_type, 0.5 * number if is_float else number)


def on(name: str, act: Change) -> Change:
    """A change of what a field holds."""
    return lambda message: act(getattr(message, name))


def assign(item: FieldDescriptor) -> Change:
    return lambda message: setattr(message, item.name, scalar(item, 3))


def clear(name: str) -> Change:
    return lambda message: message.ClearField(name)


def in_second(change: Change) -> Change:
    return lambda parts: change(parts[1])


def changes(message: Any) -> Iterator[tuple[str, Change]]:
    """Each single change of a filled message, nested ones included, and the field of the message that it is in."""
    for item in message.DESCRIPTOR.fields:
        name, part = item.name, getattr(message, item.name)
        if is_map(item):
            yield name, on(name, lambda it: it.pop(next(iter(it))))
        elif item.is_repeated:
            yield name, on(name, lambda it: it.pop())
            yield name, on(name, lambda it: it.append(it[0]))
            yield name, on(name, lambda it: it.reverse())
            for _, change in changes(part[1]) if item.message_type is not None else ():
                yield name, on(name, in_second(change))
        elif item.message_type is not None:
            for _, change in changes(part):
                yield name, on(name, change)
        else:
            yield name, assign(item)
            yield name, clear(name)


def differences(kind: str, recorded: Any, again: Any, payload: bytes = b"") -> list[Difference]:
    """Differences of a recorded message, with bytes at its end, from a replayed one."""
    diff, key = MessageDiff(), keys.key("cstr", kind, "x")
    message = encode(Publication(key, recorded))
    diff.add_recorded(message._replace(payload=message.payload + payload), kind)
    diff.add_replayed([Publication(key, again)])
    diff.finish()
    assert diff.differing == len(diff.differences)
    assert diff.counts[kind].equal == (0 if diff.differences else 1)
    return diff.differences


def test_every_kind_that_is_compared_is_tested() -> None:
    assert set(TYPES) == COMPARED


@pytest.mark.parametrize(("kind", "type_"), TYPES.items(), ids=TYPES)
def test_each_change_of_a_message_is_a_difference_in_its_field(kind: str, type_: type[Body]) -> None:
    recorded, count = fill(type_()), 0
    assert differences(kind, recorded, fill(type_())) == []
    for name, change in changes(recorded):
        again = fill(type_())
        change(again)
        assert again != recorded, name
        found = [item.what for item in differences(kind, recorded, again)]
        other = [NOT_REPLAYED] if again.time_ns > recorded.time_ns else [NOT_RECORDED, NOT_REPLAYED]
        assert found == [name] or (name == "time_ns" and sorted(found) == other[: len(found)]), (name, found)
        count += 1
    assert count >= len(type_.DESCRIPTOR.fields)


@pytest.mark.parametrize(("kind", "type_"), TYPES.items(), ids=TYPES)
def test_a_field_that_this_version_does_not_have_is_a_difference(kind: str, type_: type[Body]) -> None:
    unknown = b"\xa0\x1f\x01"  # the number 1 in field 500
    (found,) = differences(kind, fill(type_()), fill(type_()), unknown)
    assert (found.what, found.recorded, found.again) == (UNKNOWN, f"{len(unknown)} bytes", "0 bytes")


@pytest.mark.parametrize(
    ("name", "field"), [("suspects", "suspects"), ("text of a suspect", "suspects"), ("limit", "limit")]
)
def test_an_alarm_with_other_suspects_or_limits_by_the_last_bit_is_no_proof(name: str, field: str) -> None:
    """The two that an operator acts on."""
    recorded, again = fill(Alarm()), fill(Alarm())
    if name == "suspects":
        again.suspects[1].probability = math.nextafter(again.suspects[1].probability, math.inf)
    elif name == "text of a suspect":
        recorded.suspects[1].text, again.suspects[1].text = "15 % of it", "15 %  of it"
    else:
        again.limit = math.nextafter(again.limit, math.inf)
    assert [item.what for item in differences(keys.ALARM, recorded, again)] == [field]
