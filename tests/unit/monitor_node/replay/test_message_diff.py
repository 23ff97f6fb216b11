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


CHART = "reactor/cstr/chart/x/T"


def point(time_ns: int, statistic: float = 1.0) -> Publication:
    """A point of a chart."""
    return Publication(CHART, ChartPoint(time_ns=time_ns, statistic=statistic))


def compared(recorded: list[Publication], replayed: list[Publication], *, replayed_first: bool = False) -> MessageDiff:
    """Comparison of a run."""
    diff = MessageDiff()
    if replayed_first:
        diff.add_replayed(replayed)
    for item in recorded:
        diff.add_recorded(encode(item), keys.CHART)
    if not replayed_first:
        diff.add_replayed(replayed)
    diff.finish()
    return diff


@pytest.mark.parametrize("replayed_first", [True, False])
def test_messages_that_one_side_does_not_have_are_differences_and_those_around_them_are_equal(
    *, replayed_first: bool
) -> None:
    recorded, replayed = [point(time) for time in (1, 2, 4, 6)], [point(time) for time in (1, 3, 4, 5, 6)]
    diff = compared(recorded, replayed, replayed_first=replayed_first)
    assert [(item.key, item.time_ns, item.what) for item in diff.differences] == [
        (CHART, 2, NOT_REPLAYED),
        (CHART, 3, NOT_RECORDED),
        (CHART, 5, NOT_RECORDED),
    ]
    assert [(item.recorded, item.again) for item in diff.differences] == [
        ("time_ns: 2 statistic: 1", ""),
        ("", "time_ns: 3 statistic: 1"),
        ("", "time_ns: 5 statistic: 1"),
    ]
    count = diff.counts[keys.CHART]
    assert (count.recorded, count.equal, diff.differing, diff.unrecorded) == (4, 3, 3, 0)


def test_messages_replayed_after_the_last_recorded_one_are_counted_and_are_no_differences() -> None:
    """The recording had ended."""
    diff = compared([point(1), point(2)], [point(time) for time in range(1, 8)])
    assert (diff.differing, diff.unrecorded, diff.counts[keys.CHART].equal) == (0, 5, 2)


def test_a_message_of_another_key_replayed_before_the_last_recorded_one_is_a_difference() -> None:
    other = Publication("reactor/cstr/chart/y/T", ChartPoint(time_ns=1))
    diff = MessageDiff()
    diff.add_recorded(encode(point(1)), keys.CHART)
    diff.add_recorded(encode(point(2)), keys.CHART)
    diff.add_replayed([point(1), other, point(2), other])
    diff.finish()
    assert [(item.key, item.what) for item in diff.differences] == [(other.key, NOT_RECORDED)]
    assert (diff.differing, diff.unrecorded) == (1, 1)


def test_recorded_messages_that_are_not_replayed_to_the_end_are_differences() -> None:
    diff = compared([point(time) for time in range(1, 8)], [point(1), point(2)])
    assert [(item.time_ns, item.what) for item in diff.differences] == [(time, NOT_REPLAYED) for time in range(3, 8)]
    diff.finish()
    assert diff.differing == 5, "each is counted once"


def test_a_recorded_message_that_cannot_be_decoded_is_a_difference_with_the_reason() -> None:
    diff = MessageDiff()
    diff.add_recorded(encode(point(1))._replace(payload=b"\xff\xff"), keys.CHART)
    diff.finish()
    (found,) = diff.differences
    assert (found.key, found.time_ns, found.what, found.again) == (CHART, 0, "payload", "")
    assert found.recorded
    assert (diff.counts[keys.CHART].recorded, diff.counts[keys.CHART].equal) == (1, 0)


def test_at_most_100_differences_are_listed_and_all_are_counted() -> None:
    diff = compared([point(time) for time in range(150)], [point(time, 2.0) for time in range(150)])
    assert [item.time_ns for item in diff.differences] == list(range(100))
    assert {(item.what, item.recorded, item.again) for item in diff.differences} == {("statistic", "1.0", "2.0")}
    assert (diff.differing, diff.counts[keys.CHART].equal) == (150, 0)


def test_the_differences_of_several_runs_are_added_in_the_order_of_time() -> None:
    first = compared([point(time) for time in range(0, 120, 2)], [point(time, 2.0) for time in range(0, 120, 2)])
    second = compared([point(time) for time in range(1, 121, 2)], [point(time, 2.0) for time in range(1, 131, 2)])
    first.add(second)
    assert [item.time_ns for item in first.differences] == list(range(100))
    count = first.counts[keys.CHART]
    assert (first.differing, first.unrecorded, count.recorded, count.equal) == (120, 5, 120, 0)
    equal = compared([point(1)], [point(1), point(2)])
    equal.add(equal)
    assert (equal.unrecorded, equal.counts[keys.CHART].recorded, equal.counts[keys.CHART].equal) == (2, 2, 2)
    empty = MessageDiff()
    empty.add(second)
    assert (empty.counts[keys.CHART].recorded, empty.differing) == (60, 60)


def test_differences_of_several_keys_are_in_the_order_of_time() -> None:
    diff = MessageDiff()
    for key, times in (("reactor/cstr/chart/y/T", (2, 4)), (CHART, (1, 3))):
        for time_ns in times:
            diff.add_recorded(encode(Publication(key, ChartPoint(time_ns=time_ns))), keys.CHART)
    diff.finish()
    assert [item.time_ns for item in diff.differences] == [1, 2, 3, 4]


def test_a_message_of_another_type_on_a_key_is_a_difference_that_names_both() -> None:
    """Also where the bytes are the same."""
    assert ChartPoint(time_ns=1).SerializeToString() == Estimate(time_ns=1).SerializeToString()
    (found,) = differences(keys.CHART, ChartPoint(time_ns=1), Estimate(time_ns=1))
    assert found[2:] == ("message", "reactorwatch.v1.ChartPoint", "reactorwatch.v1.Estimate")


def test_nan_is_equal_to_itself() -> None:
    assert differences(keys.CHART, ChartPoint(statistic=math.nan), ChartPoint(statistic=math.nan)) == []


def test_of_several_fields_that_differ_the_first_is_named() -> None:
    recorded, again = ChartPoint(time_ns=1, statistic=1.0, upper_limit=3.0), ChartPoint(time_ns=1, statistic=2.0)
    (found,) = differences(keys.CHART, recorded, again)
    assert found[2:] == ("statistic", "1.0", "2.0")


def test_the_same_values_in_another_order_of_the_fields_are_equal() -> None:
    diff, message = MessageDiff(), ChartPoint(time_ns=1, statistic=2.0)
    payload = ChartPoint(statistic=2.0).SerializeToString() + ChartPoint(time_ns=1).SerializeToString()
    assert payload != message.SerializeToString()
    diff.add_recorded(encode(Publication(CHART, message))._replace(payload=payload), keys.CHART)
    diff.add_replayed([Publication(CHART, message)])
    diff.finish()
    assert (diff.differing, diff.counts[keys.CHART].equal) == (0, 1)
