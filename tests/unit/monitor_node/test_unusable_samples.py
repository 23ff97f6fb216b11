"""Samples that come and cannot be used are counted by their reason, and an alarm names it instead of a silence."""

import math
from collections.abc import Callable

import pytest

from monitor_node.config import MonitorConfig
from monitor_node.core import Monitor
from reactorwatch.contract.codec import Encoded, Publication, decode, encode
from reactorwatch.contract.messages_pb2 import Alarm, Health, Quality, Sample

from .samples import leaking_run, samples

ROWS, PERIOD_NS, SECOND_NS = 100, 6_000_000_000, 1_000_000_000
CONFIG = MonitorConfig(training_min=60.0, diagnose_training=False, isolation=False)


def in_unit(unit: str) -> Callable[[Encoded], Encoded]:
    """Samples in another unit."""
    return lambda message: changed(message, unit=unit)


def changed(message: Encoded, **fields: object) -> Encoded:
    sample = decode(message.payload, message.encoding)
    assert isinstance(sample, Sample)
    for name, value in fields.items():
        setattr(sample, name, value)
    return encode(Publication(message.key, sample))


def in_version(number: int) -> Callable[[Encoded], Encoded]:
    """Samples of another version of the schema."""
    encoding = f"application/protobuf;reactorwatch.v{number}.Sample"
    return lambda message: message._replace(encoding=encoding)


KINDS = {
    "an unknown unit": ("unit", in_unit("degrees of Kelvin"), "degrees of Kelvin"),
    "a unit of another quantity": ("unit", in_unit("bar"), "bar"),
    "a later version": ("version", in_version(2), "reactorwatch.v2"),
    "a version of two digits": ("version", in_version(10), "reactorwatch.v10"),
    "a bad quality": ("bad_quality", lambda message: changed(message, quality=Quality.QUALITY_BAD), "marked bad"),
    "no number": ("not_finite", lambda message: changed(message, value=math.nan), "nan"),
    "an impossible size": ("out_of_range", lambda message: changed(message, value=1e300), "1e+300"),
}


def run(sound_rows: int, spoil: Callable[[Encoded], Encoded], signals: tuple[str, ...]) -> tuple[Monitor, list[Alarm]]:
    """A monitor, each of whose rows arrives in six seconds; from a row on samples of some signals are spoilt."""
    monitor, published = Monitor(CONFIG, 0), list[Publication]()
    for number, message in enumerate(samples(*leaking_run(0.0, 1.0, 30.0, seed=3))):
        row, now_ns = number // 3, (number // 3 + 1) * PERIOD_NS + number % 3 * SECOND_NS
        if row == sound_rows + ROWS:
            break
        if monitor.next_tick_ns() <= now_ns:
            published += monitor.on_tick(now_ns)
        is_spoilt = row >= sound_rows and message.key.rsplit("/", 1)[1] in signals
        published += monitor.on_message(spoil(message) if is_spoilt else message, now_ns)
    return monitor, [item.message for item in published if isinstance(item.message, Alarm)]


def health(monitor: Monitor) -> Health:
    (last,) = monitor.on_stop(0)
    assert isinstance(last.message, Health)
    return last.message


@pytest.mark.parametrize("sound_rows", [0, 60], ids=["from the start", "after sound rows"])
@pytest.mark.parametrize(("reason", "spoil", "named"), KINDS.values(), ids=KINDS)
def test_where_no_sample_of_a_plant_can_be_used_the_alarm_and_the_counts_name_the_reason(
    reason: str, spoil: Callable[[Encoded], Encoded], named: str, sound_rows: int
) -> None:
    monitor, alarms = run(sound_rows, spoil, ("qc", "C", "T"))
    assert dict(health(monitor).refused_by_reason) == {reason: 3 * ROWS}
    assert [(alarm.alarm, alarm.event) for alarm in alarms] == [("silence/plant", "raised")]
    assert alarms[0].text.startswith("no usable sample of the plant comes: ")
    assert named in alarms[0].text


@pytest.mark.parametrize(("reason", "spoil", "named"), KINDS.values(), ids=KINDS)
def test_where_no_sample_of_a_signal_can_be_used_its_alarm_names_the_reason(
    reason: str, spoil: Callable[[Encoded], Encoded], named: str
) -> None:
    monitor, alarms = run(60, spoil, ("T",))
    assert dict(health(monitor).refused_by_reason) == {reason: ROWS}
    assert [(alarm.alarm, alarm.event) for alarm in alarms] == [("silence/T", "raised")]
    assert alarms[0].text.startswith("no usable sample of T comes: ")
    assert named in alarms[0].text


@pytest.mark.parametrize(("_reason", "spoil", "_named"), KINDS.values(), ids=KINDS)
def test_the_next_usable_sample_ends_the_alarm(_reason: str, spoil: Callable[[Encoded], Encoded], _named: str) -> None:
    monitor, _ = run(0, spoil, ("qc", "C", "T"))
    resumed = Monitor(CONFIG, 0)
    resumed.from_bytes(monitor.to_bytes())
    published = [
        item
        for number, message in enumerate(samples(*leaking_run(0.0, 1.0, 10.0, seed=3)))
        for item in resumed.on_message(message, (2 * ROWS + number) * PERIOD_NS)
    ]
    changes = [item.message for item in published if isinstance(item.message, Alarm)]
    assert [(alarm.alarm, alarm.event) for alarm in changes] == [("silence/plant", "cleared")]


def test_garbage_among_the_samples_of_a_sound_plant_raises_nothing() -> None:
    """As much as comes in a flood; none of it is a sample of this software."""
    monitor, alarms = Monitor(CONFIG, 0), list[Publication]()
    for number, message in enumerate(samples(*leaking_run(0.0, 1.0, 5.0, seed=3))):
        for _ in range(100):
            alarms += monitor.on_message(message._replace(encoding="application/json"), number)
        alarms += monitor.on_tick(number) if monitor.next_tick_ns() <= number else []
        alarms += monitor.on_message(message, number)
    assert not [item for item in alarms if isinstance(item.message, Alarm)]


@pytest.mark.parametrize("is_behind", [True, False])
def test_a_monitor_with_messages_to_process_does_not_call_the_plant_silent(*, is_behind: bool) -> None:
    """A timeout in receive time expires while the plant's samples may be among the messages that wait."""
    monitor, _ = run(60, lambda message: message, ())
    now_ns = monitor.silence.of_plant.due_ns()
    assert now_ns is not None
    monitor.is_behind = is_behind
    published = monitor.on_tick(now_ns)
    raised = [item.message.alarm for item in published if isinstance(item.message, Alarm)]
    assert raised == ([] if is_behind else ["silence/plant"])
